"""The paper's tables, and what their averages are: several printed ones do not follow from the figures beside them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import resources

import yaml


@dataclass(frozen=True)
class PaperRow:
    """One method in one table.

    Attributes:
        method: its name. A variant of the paper's own begins with "HiNeuS, ".
        scores: scene -> figure as printed.
        printed: the average that the paper prints.
    """

    method: str
    scores: dict[str, float]
    printed: float

    @property
    def average(self) -> float:
        """Mean of the figures."""
        return sum(self.scores.values()) / len(self.scores)

    def deviates(self, decimals: int) -> bool:
        """Whether the printed average, of so many decimals, is another than that of the figures."""
        return abs(self.average - self.printed) > 0.501 * 10.0**-decimals


@dataclass(frozen=True)
class PaperTable:
    """One table: its label in the paper's source, its scenes in order, its rows."""

    label: str
    scenes: tuple[str, ...]
    rows: tuple[PaperRow, ...]


@cache
def paper_tables() -> dict[str, PaperTable]:
    """Suite -> table, for the suites the paper has figures of."""
    text = (resources.files("stages.evaluation") / "suites" / "paper.yaml").read_text(encoding="utf-8")
    return {
        suite: PaperTable(
            table["table"],
            tuple(table["scenes"]),
            tuple(
                PaperRow(row["method"], dict(zip(table["scenes"], row["scores"], strict=True)), row["average"])
                for row in table["rows"]
            ),
        )
        for suite, table in yaml.safe_load(text).items()
    }
