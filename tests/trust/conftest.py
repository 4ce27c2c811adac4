"""What all tests of trust share: one tiny run, and how much of the whole is asked for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from tiny import Tiny, make_tiny
from trust_runs import Ended, import_what_is_slow

COUNTS = pytest.StashKey[dict[str, list[Ended]]]()


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Tiny:
    """The unbroken run."""
    import_what_is_slow()
    folder: Path = tmp_path_factory.mktemp("trust") / "tiny"
    folder.mkdir()
    return make_tiny(folder)


@pytest.fixture(scope="session")
def whole(request: pytest.FixtureRequest) -> bool:
    """Whether all is asked for (`make trust`), not the share of it that fits into every run of the tests."""
    return bool(request.config.getoption("--whole"))


@pytest.fixture(scope="session")
def record_trust(request: pytest.FixtureRequest) -> Callable[[str, Ended], None]:
    """Counts a run under the name of its kind, for the table at the end."""
    counts: dict[str, list[Ended]] = request.config.stash.setdefault(COUNTS, {})
    return lambda name, ended: counts.setdefault(name, []).append(ended)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """One row a kind of input: how many runs, how many of them ended badly, the slowest and the largest."""
    counts = config.stash.get(COUNTS, {})
    if not counts:
        return
    everything = [ended for runs in counts.values() for ended in runs]
    write = terminalreporter.write_line
    write("\n| input | runs | refused | tracebacks | hangs | slowest s | peak GiB |\n|---|---|---|---|---|---|---|")
    for name, runs in {**counts, "all": everything}.items():
        refused, tracebacks = sum(run.code != 0 for run in runs), sum("traceback" in run.fault() for run in runs)
        slowest, peak = max(run.seconds for run in runs), max(run.peak_bytes for run in runs) / (1 << 30)
        hangs = sum(run.killed for run in runs)
        write(f"| {name} | {len(runs)} | {refused} | {tracebacks} | {hangs} | {slowest:.1f} | {peak:.2f} |")
