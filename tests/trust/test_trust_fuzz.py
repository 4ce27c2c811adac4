"""Wrong input through every entry point: a sentence, in bounded time and memory, and nothing outside is touched."""

from __future__ import annotations

import itertools
import shutil
from pathlib import Path

import pytest
from entry_points import ENTRY_POINTS, EntryPoint, some_photos, wrong_inputs
from hypothesis import HealthCheck, Phase, given, seed, settings
from tiny import RUN, Tiny
from trust_runs import run_hineus

pytestmark = pytest.mark.slow

WHOLE, SHARE = 12, 0.5  # inputs for each unit of an entry point's share
PLANTED = "from pathlib import Path\nPath(__file__).with_name('executed').touch()\n"


@pytest.mark.parametrize("entry", ENTRY_POINTS, ids=lambda entry: entry.name)
def test_wrong_input_gets_a_sentence(entry: EntryPoint, tiny: Tiny, whole: bool, tmp_path: Path, record_trust):
    places, faults = itertools.count(), []
    victim = tmp_path / "victim"
    victim.write_text("precious")

    def folder() -> Path:
        place = tmp_path / f"{next(places):04d}"
        place.mkdir()
        return place

    @seed(1)
    @settings(
        max_examples=int(entry.share * (WHOLE if whole else SHARE)),
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(wrong_inputs(entry, tiny, folder))
    def attempt(laid) -> None:
        place, commands = laid
        bad = False
        for command in commands:
            ended = run_hineus(command, place, entry.seconds, first=entry.first)
            record_trust(entry.name, ended)
            if fault := ended.fault():
                bad = True
                faults.append(f"{place.name}: hineus {' '.join(command)[:200]}: {fault}\n{ended.output[-1500:]}")
        if not bad:
            shutil.rmtree(place)

    attempt()
    assert victim.read_text() == "precious"
    assert not faults, f"{len(faults)} faults of {entry.name} (inputs kept in {tmp_path}):\n" + "\n".join(faults)


def _cases() -> list[Path]:
    cases = Path(__file__).parents[3] / "shared" / "cases"
    kinds = {"trust-09": "config_*", "trust-11": "poses_*", "trust-12": "mesh_*", "trust-13": "photo_*"}
    return sorted(file for start, form in kinds.items() for file in cases.glob(f"{start}*/{form}"))


@pytest.mark.parametrize("case", _cases(), ids=lambda case: case.name)
def test_what_went_wrong_once_does_no_more(case: Path, tiny: Tiny, tmp_path: Path):
    place = tmp_path / "here"
    place.mkdir()
    some_photos(tiny, place)
    if case.name.startswith("photo_"):
        shutil.copy(case, place / "p")
    run = ["run", "p", "-w", "w", "--until", "ingest", *RUN]
    mesh = str(tiny.input("mesh.ply"))
    commands = {
        "config": [["config", "--config", str(case)]],
        "poses": [[*run, "--poses", str(case)]],
        "mesh": [["compare", str(case), mesh], ["evaluate", "mesh", mesh, str(case)]],
        "photo": [["check", "p"], run],
    }[case.name.partition("_")[0]]
    for command in commands:
        ended = run_hineus(command, place)
        assert not ended.fault(), ended.output


def test_code_that_lies_about_is_not_run(tiny: Tiny, whole: bool, tmp_path: Path):
    place = tmp_path / "here"
    shutil.copytree(tiny.workspace, place / "w")
    for name in ("numpy", "torch", "cv2", "xatlas", "pymeshlab", "secrets", "stages", "sitecustomize"):
        (place / f"{name}.py").write_text(PLANTED)
    commands = [["run", str(tiny.photos), "-w", "w", "--from", "atlas", "--until", "atlas", *RUN]]
    for command in [["doctor"], *commands] if whole else commands:  # the doctor takes seconds
        ended = run_hineus(command, place, 120, environment={"PYTHONPATH": f":{place}"})
        assert not (place / "executed").exists(), ended.output
