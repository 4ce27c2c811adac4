"""A pipeline of four tiny stages: the engine's test object.

ingest reads the first letters of the photos; sfm repeats them and can be told to die; undistort reduces
that to one bit, so most changes end there; export writes the bit.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from configs.params import Config
from stages.artifacts.artifact import Artifact
from stages.engine.runner import run_pipeline
from stages.engine.stage import Stage, StageContext
from stages.engine.workspace import Workspace


def text_artifact(stage: str, file: str) -> Artifact[str]:
    return Artifact(
        stage,
        (file,),
        lambda folder: (folder / file).read_text(),
        lambda folder, text: (folder / file).write_text(text),
    )


LETTERS = text_artifact("ingest", "letters.txt")
POSES = text_artifact("sfm", "model/poses.txt")
LONG = text_artifact("undistort", "long.txt")
MODEL = text_artifact("export", "model.glb")


def ingest(context: StageContext) -> dict[str, Any]:
    photos = sorted(context.sources["photos"].iterdir())
    text = "".join(path.read_text(errors="replace")[0] for path in photos)
    context.write(LETTERS, text)
    return {"photos": len(photos), "masked": "masks" in context.sources}


def sfm(context: StageContext) -> dict[str, Any]:
    """Counts to `max_features` / 100 in its scratch folder; kills itself where TOY_KILL_AT says so."""
    counter = context.scratch / "count"
    start = int(counter.read_text()) if counter.exists() else 0
    end = context.params.max_features // 100
    for count in range(start, end):
        (context.scratch / "next").write_text(str(count + 1))
        (context.scratch / "next").replace(counter)
        context.progress(count + 1, end, "counting")
        if os.environ.get("TOY_KILL_AT") == str(count + 1):
            os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(float(os.environ.get("TOY_SLEEP", "0")))
    (context.out / "model").mkdir()
    context.write(POSES, context.read(LETTERS) * end)
    return {"started_at": start, "ended_at": end}


def undistort(context: StageContext) -> dict[str, Any]:
    context.write(LONG, str(len(context.read(POSES)) > 10))
    return {}


def export(context: StageContext) -> dict[str, Any]:
    context.write(MODEL, context.read(LONG))
    return {"nan": float("nan")}


TOY: tuple[Stage, ...] = (
    Stage(
        "ingest",
        1,
        lambda config: config.ingest,
        ingest,
        (),
        (LETTERS,),
        ("photos", "masks"),
        summary="photos to letters",
    ),
    Stage("sfm", 1, lambda config: config.sfm, sfm, (LETTERS,), (POSES,), summary="letters to poses"),
    Stage("undistort", 1, lambda config: config.undistort, undistort, (POSES,), (LONG,), summary="poses to one bit"),
    Stage("export", 1, lambda config: config.export, export, (LONG,), (MODEL,), summary="one bit to a file"),
)


def with_stage(name: str, **changes: Any) -> tuple[Stage, ...]:
    """The toy pipeline with one stage changed."""
    return tuple(replace(stage, **changes) if stage.name == name else stage for stage in TOY)


def failing(error: Callable[[], BaseException], after: str = "partial.txt") -> Callable[[StageContext], dict[str, Any]]:
    """A stage's run that writes a file and then raises."""

    def run(context: StageContext) -> dict[str, Any]:
        (context.out / after).write_text("half")
        raise error()

    return run


def main() -> None:
    """`python toy_pipeline.py WORKSPACE PHOTOS`: for tests that need a process to kill or to wait for."""
    workspace, photos = map(Path, sys.argv[1:3])
    run_pipeline(TOY, Workspace.open(workspace, create=True), Config(), {"photos": photos, "masks": None})


if __name__ == "__main__":
    main()
