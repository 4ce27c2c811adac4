"""The engine on a toy pipeline: skip, re-run and its reason, kill, damage, two processes, full disk."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from toy_pipeline import LETTERS, MODEL, POSES, TOY, failing, text_artifact, with_stage

from configs.load import load_config
from configs.params import Config
from stages.engine import damage as damage_module
from stages.engine import manifest as manifest_module
from stages.engine import status as status_module
from stages.engine import workspace as workspace_module
from stages.engine.damage import damage_named
from stages.engine.fingerprint import SourceDigests, file_sha256
from stages.engine.manifest import MANIFEST, Manifest, ManifestDamaged, OutputFile, load_manifest
from stages.engine.resources import ResourceMeter
from stages.engine.runner import StageOutcome, run_pipeline
from stages.engine.stage import StageContext
from stages.engine.status import Present, StageStatus, pipeline_status
from stages.engine.workspace import FORMAT, Workspace
from stages.errors import (
    ConfigError,
    HineusError,
    InputError,
    ReconstructionError,
    SystemRequirementError,
    WorkspaceError,
)

REPOSITORY = Path(__file__).parents[1]


class Bench:
    """A workspace, some photos, and the toy pipeline over them."""

    def __init__(self, folder: Path) -> None:
        self.photos = folder / "photos"
        self.photos.mkdir()
        for index, text in enumerate(["apple", "banana", "cherry"]):
            (self.photos / f"IMG_{index}.jpg").write_text(text)
        self.root = folder / "workspace"
        self.masks: Path | None = None

    @property
    def workspace(self) -> Workspace:
        return Workspace.open(self.root, create=True)

    def run(self, pipeline: Any = TOY, sets: tuple[str, ...] = (), **options: Any) -> list[StageOutcome]:
        sources = {"photos": self.photos, "masks": self.masks}
        return run_pipeline(pipeline, self.workspace, load_config(sets=sets), sources, **options)

    def ran(self, pipeline: Any = TOY, sets: tuple[str, ...] = (), **options: Any) -> dict[str, str]:
        """Stage -> reason, of the stages that ran."""
        return {o.name: o.reason for o in self.run(pipeline, sets, **options) if o.action == "ran"}

    def states(self, sets: tuple[str, ...] = (), hashes: bool = False) -> dict[str, str]:
        digests = SourceDigests({"photos": self.photos, "masks": self.masks})
        statuses = pipeline_status(TOY, Present(self.workspace, load_config(sets=sets), digests), hashes)
        return {status.name: f"{status.state}: {status.reason}" for status in statuses}

    def process(self, **environment: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "tests/toy_pipeline.py", str(self.root), str(self.photos)],
            cwd=REPOSITORY,
            env={**os.environ, "PYTHONPATH": str(REPOSITORY), **environment},
            stderr=subprocess.PIPE,
        )


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


# ---------------------------------------------------------------- skipping and re-running
def test_first_run_makes_everything_and_second_skips_it(bench: Bench) -> None:
    assert list(bench.ran()) == ["ingest", "sfm", "undistort", "export"]
    second = bench.run()
    assert [outcome.action for outcome in second] == ["skipped"] * 4
    assert {outcome.reason for outcome in second} == {"nothing changed"}
    assert second[0].numbers == {"photos": 3, "masked": False}


def test_changed_parameter_is_named_and_stops_where_outputs_are_the_same(bench: Bench) -> None:
    bench.run()
    ran = bench.ran(sets=("sfm.max_features=4096",))
    # undistort writes the same bit for fewer features, so export stays fresh
    assert ran == {
        "sfm": "parameter sfm.max_features changed 8192 -> 4096",
        "undistort": "input sfm/model/poses.txt changed",
    }


def test_changed_parameter_runs_to_the_end_where_outputs_differ(bench: Bench) -> None:
    bench.run()
    assert list(bench.ran(sets=("sfm.max_features=200",))) == ["sfm", "undistort", "export"]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda photos: (photos / "IMG_1.jpg").write_text("blueberry"), "photo IMG_1.jpg changed"),
        (lambda photos: (photos / "IMG_9.jpg").write_text("date"), "photo IMG_9.jpg added"),
        (lambda photos: (photos / "IMG_2.jpg").unlink(), "photo IMG_2.jpg removed"),
        (
            lambda photos: [(photos / f"X{i}.jpg").write_text("x") for i in range(5)],
            "5 photos added (X0.jpg, X1.jpg, X2.jpg, ...)",
        ),
    ],
)
def test_changed_photos_are_named(bench: Bench, change: Any, reason: str) -> None:
    bench.run()
    change(bench.photos)
    assert bench.states()["ingest"] == f"stale: {reason}"
    assert bench.states()["sfm"] == "stale: input stage ingest is stale"
    assert bench.ran()["ingest"] == reason


def test_photo_changed_without_effect_ends_at_the_first_stage(bench: Bench) -> None:
    bench.run()
    (bench.photos / "IMG_1.jpg").write_text("blueberry")  # the same first letter
    assert list(bench.ran()) == ["ingest"]


def test_touched_photo_and_hidden_files_change_nothing(bench: Bench) -> None:
    bench.run()
    os.utime(bench.photos / "IMG_0.jpg")
    (bench.photos / ".DS_Store").write_text("")
    assert bench.ran() == {}


def test_moved_photos_change_nothing(bench: Bench, tmp_path: Path) -> None:
    bench.run()
    bench.photos = bench.photos.rename(tmp_path / "elsewhere")
    assert bench.ran() == {}


def test_masks_given_later_are_a_reason(bench: Bench, tmp_path: Path) -> None:
    bench.run()
    bench.masks = tmp_path / "masks"
    bench.masks.mkdir()
    (bench.masks / "IMG_0.png").write_text("m")
    assert bench.ran() == {"ingest": "masks are now given"}
    (bench.masks / "IMG_0.png").write_text("n")
    assert bench.ran() == {"ingest": "mask IMG_0.png changed"}


def test_raised_stage_version_is_a_reason(bench: Bench) -> None:
    bench.run()
    assert bench.ran(with_stage("undistort", version=2)) == {"undistort": "stage version 1 -> 2"}


def test_device_and_workers_are_no_reason(bench: Bench) -> None:
    bench.run(device="cpu", workers=1)
    assert bench.ran(device="cuda", workers=7) == {}


def test_missing_and_truncated_outputs_are_made_again(bench: Bench) -> None:
    bench.run()
    (bench.root / "sfm" / "model" / "poses.txt").unlink()
    assert bench.states()["sfm"] == "missing: output model/poses.txt missing"
    assert bench.ran() == {"sfm": "output model/poses.txt missing"}  # same output again, so nothing after it
    (bench.root / "ingest" / "letters.txt").write_text("ab")
    assert bench.ran() == {"ingest": "output letters.txt damaged (2 bytes, published with 3)"}


def test_flipped_bits_are_found_in_small_files_at_once_and_in_large_ones_on_request(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.run()
    (bench.root / "ingest" / "letters.txt").write_text("abX")
    found = "output letters.txt damaged (contents changed)"
    assert bench.states()["ingest"] == f"missing: {found}"
    monkeypatch.setattr(status_module, "CHEAP_BYTES", 2)
    assert bench.states()["ingest"].startswith("fresh")
    assert bench.states(hashes=True)["ingest"] == f"missing: {found}"
    monkeypatch.undo()
    assert bench.ran() == {"ingest": found}


DAMAGES: dict[str, Callable[[Path], Any]] = {
    "flipped": lambda file: file.write_text(file.read_text()[:-1] + "X"),
    "truncated": lambda file: file.write_text(""),
    "removed": lambda file: file.unlink(),
    "a folder": lambda file: (file.unlink(), file.mkdir()),
    "without manifest": lambda file: (file.parents[1] / MANIFEST).write_text("{"),
    "gone": lambda file: shutil.rmtree(file.parents[1]),
}


@pytest.mark.parametrize("error", [KeyError("a raw error"), MemoryError(), ReconstructionError("too few", "take more")])
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_stage_that_fails_on_damaged_input_names_the_stage_to_run_again(
    bench: Bench, damage: str, error: Exception
) -> None:
    def run(context: StageContext) -> dict[str, Any]:
        DAMAGES[damage](bench.root / "sfm" / "model" / "poses.txt")  # large, or while the run goes on
        raise error

    with pytest.raises(WorkspaceError, match=f"{bench.root}/sfm is not as it was published: ") as caught:
        bench.run(with_stage("undistort", run=run))
    assert caught.value.hint == f"Make it again: `hineus run --workspace {bench.root} --force sfm`."
    assert caught.value.__cause__ is error
    bench.run(force=("sfm",))
    assert set(bench.states(hashes=True).values()) == {"fresh: nothing changed"}


def test_a_stage_reads_nothing_that_is_damaged(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.run()
    DAMAGES["flipped"](bench.root / "sfm" / "model" / "poses.txt")
    monkeypatch.setattr(status_module, "CHEAP_BYTES", 2)  # the file is a large one
    pipeline = with_stage("undistort", run=failing(lambda: AssertionError("it was run")), version=2)
    with pytest.raises(WorkspaceError, match=r"output model/poses\.txt damaged") as caught:
        bench.run(pipeline)
    assert caught.value.__cause__ is None
    monkeypatch.setattr(damage_module, "ENOUGH_BYTES", 2)  # and of the largest
    with pytest.raises(WorkspaceError, match=r"output model/poses\.txt damaged") as caught:
        bench.run(pipeline)
    assert str(caught.value.__cause__) == "it was run"


def test_damage_is_named_outside_of_runs_too(bench: Bench) -> None:
    bench.run()
    with pytest.raises(KeyError, match="what has nothing to do with it"), damage_named(bench.workspace, ["sfm"]):
        raise KeyError("what has nothing to do with it")
    DAMAGES["flipped"](bench.root / "sfm" / "model" / "poses.txt")
    with pytest.raises(WorkspaceError, match="not as it was published"), damage_named(bench.workspace, ["sfm"]):
        raise AssertionError("it was read")


@pytest.mark.parametrize("removed", [False, True])
def test_a_photo_that_changes_while_it_is_read_is_told(
    bench: Bench, removed: bool, caplog: pytest.LogCaptureFixture
) -> None:
    photo = bench.photos / "IMG_1.jpg"

    def run(context: StageContext) -> dict[str, Any]:
        photo.unlink() if removed else photo.write_text("Blueberry")
        return TOY[0].run(context)

    def fail(context: StageContext) -> dict[str, Any]:
        run(context)
        raise ValueError("a raw error")

    said = f"{photo} was {'removed' if removed else 'changed'} while stage ingest read it"
    with pytest.raises(InputError, match=said):
        bench.run(with_stage("ingest", run=fail))
    photo.write_text("banana")
    bench.run(with_stage("ingest", run=run))
    assert f"{said}: the next run takes it in anew" in caplog.text
    assert bench.ran()["ingest"] == f"photo IMG_1.jpg {'removed' if removed else 'changed'}"


def test_looking_at_a_publication_that_is_replaced_this_instant_is_no_error(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.run()
    before = Manifest.from_json((bench.root / "sfm" / MANIFEST).read_text())
    original = manifest_module.file_sha256

    def vanishing(path: Path) -> str:
        shutil.rmtree(bench.root / "sfm")
        return original(path)

    monkeypatch.setattr(manifest_module, "file_sha256", vanishing)
    assert manifest_module.output_problem(bench.root / "sfm", before) == "output model/poses.txt missing"


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: "",
        lambda text: text[: len(text) // 2],
        lambda text: "[]",
        lambda text: "{}",
        lambda text: text.replace('"version": 1', '"version": 3'),
    ],
)
def test_damaged_manifest_is_never_trusted(bench: Bench, damage: Any) -> None:
    bench.run()
    manifest = bench.root / "sfm" / MANIFEST
    manifest.write_text(damage(manifest.read_text()))
    assert bench.states()["sfm"].startswith("missing: manifest damaged")
    assert bench.ran()["sfm"].startswith("manifest damaged")
    assert bench.ran() == {}


def test_folder_without_manifest_is_not_published(bench: Bench) -> None:
    bench.run()
    (bench.root / "sfm" / MANIFEST).unlink()
    assert bench.ran() == {"sfm": "not made yet"}


# ---------------------------------------------------------------- choosing stages
def test_until_from_and_force(bench: Bench) -> None:
    assert list(bench.ran(until="sfm")) == ["ingest", "sfm"]
    assert bench.ran(from_stage="undistort") == {"undistort": "not made yet", "export": "not made yet"}
    assert bench.ran(from_stage="sfm", until="undistort") == {
        "sfm": "asked for by --from sfm",
        "undistort": "asked for by --from sfm",
    }
    assert bench.ran(force=("ingest",)) == {"ingest": "asked for by --force ingest"}


def test_from_brings_earlier_stages_up_to_date(bench: Bench) -> None:
    bench.run()
    ran = bench.ran(sets=("sfm.max_features=200",), from_stage="export")
    assert list(ran) == ["sfm", "undistort", "export"]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"until": "sfmm"}, "There is no stage 'sfmm' (--until)"),
        ({"force": ("xport",)}, "There is no stage 'xport' (--force)"),
        ({"from_stage": "export", "until": "sfm"}, "--from export comes after --until sfm"),
    ],
)
def test_wrong_stage_names_are_refused(bench: Bench, options: Any, sentence: str) -> None:
    with pytest.raises(ConfigError, match=r"stage|after") as caught:
        bench.run(**options)
    assert sentence in caught.value.message
    assert not bench.root.exists()


# ---------------------------------------------------------------- crashes
def test_kill_loses_only_the_running_stage_and_keeps_its_scratch(bench: Bench) -> None:
    killed = bench.process(TOY_KILL_AT="30")
    assert killed.wait() == -9
    assert bench.states()["ingest"].startswith("fresh")
    assert bench.states()["sfm"] == "missing: not made yet"
    outcomes = {outcome.name: outcome for outcome in bench.run()}
    assert outcomes["ingest"].action == "skipped"
    assert outcomes["sfm"].numbers == {"started_at": 30, "ended_at": 81}
    assert not (bench.root / ".work" / "sfm" / "scratch").exists()


def test_scratch_of_other_settings_is_not_used(bench: Bench) -> None:
    assert bench.process(TOY_KILL_AT="30").wait() == -9
    outcomes = {outcome.name: outcome for outcome in bench.run(sets=("sfm.max_features=5000",))}
    assert outcomes["sfm"].numbers == {"started_at": 0, "ended_at": 50}


def _interrupt_at(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """Stop as a crash would at the `count`-th renaming or removing; nothing after it happens."""
    steps = iter(range(1000))

    def cut(original: Any) -> Any:
        def step(*arguments: Any, **options: Any) -> Any:
            if next(steps) >= count:
                raise KeyboardInterrupt
            return original(*arguments, **options)

        return step

    monkeypatch.setattr(Path, "rename", cut(Path.rename))
    monkeypatch.setattr(Path, "replace", cut(Path.replace))
    monkeypatch.setattr(workspace_module, "remove", cut(workspace_module.remove))


@pytest.mark.parametrize("count", range(12))
def test_crash_between_any_two_steps_of_publishing_recovers(bench: Bench, count: int) -> None:
    bench.run(sets=("sfm.max_features=200",))
    workspace = bench.workspace
    out, scratch = workspace.begin("sfm", "a fingerprint")
    (out / "model").mkdir()
    (out / "model" / "poses.txt").write_text("abc" * 2)
    (scratch / "count").write_text("2")
    old = load_manifest(bench.root / "sfm")
    assert old is not None
    manifest = Manifest(old.identity, dict(old.outputs), {"new": True})
    with pytest.MonkeyPatch.context() as patch:
        _interrupt_at(patch, count)
        try:
            workspace.publish("sfm", manifest)
        except KeyboardInterrupt:
            assert count < 7
    workspace.recover("sfm")
    found = load_manifest(bench.root / "sfm")
    assert found is not None
    assert found.numbers in (old.numbers, {"new": True})
    assert not (bench.root / ".work" / "sfm" / "old").exists()
    assert bench.ran(sets=("sfm.max_features=200",)) == {}


def test_half_removed_scratch_is_not_used(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    workspace = bench.workspace
    out, scratch = workspace.begin("sfm", "these settings")
    (scratch / "count").write_text("2")
    out.rmdir()

    def cut_off(path: Path) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", cut_off)
        with pytest.raises(KeyboardInterrupt):
            workspace.begin("sfm", "others")
    assert list(workspace.begin("sfm", "these settings")[1].iterdir()) == []


def test_a_stage_that_is_asked_for_goes_on_from_no_scratch_of_what_is_published(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cut_off(out: Path, *_: Path) -> None:
        raise KeyboardInterrupt

    sets = ("sfm.max_features=200",)
    bench.run(until="ingest", sets=sets)
    with monkeypatch.context() as patch:
        patch.setattr(workspace_module, "_replace", cut_off)
        with pytest.raises(KeyboardInterrupt):
            bench.run(sets=sets)
    outcomes = {outcome.name: outcome for outcome in bench.run(sets=sets, force=("sfm",))}
    assert outcomes["sfm"].reason == "asked for by --force sfm"
    assert outcomes["sfm"].numbers["started_at"] == 0
    assert not list((bench.root / ".work").glob("*/scratch*"))


@pytest.mark.parametrize("place", ["sfm/scratch", "sfm/out", "sfm/old", "sfm/scratch.json"])
@pytest.mark.parametrize("is_folder", [False, True])
def test_what_lies_in_the_way_of_a_stage_s_own_folders_is_removed(bench: Bench, place: str, is_folder: bool) -> None:
    inside = bench.root / ".work" / place
    inside.parent.mkdir(parents=True)
    inside.mkdir() if is_folder else inside.write_text("x")
    assert "sfm" in bench.ran()


def test_failing_stage_keeps_its_last_publication(bench: Bench) -> None:
    bench.run()
    with pytest.raises(ValueError, match="bad luck"):
        bench.run(with_stage("sfm", version=2, run=failing(lambda: ValueError("bad luck"))))
    assert not (bench.root / ".work" / "sfm" / "out").exists()
    assert bench.ran() == {}


# ---------------------------------------------------------------- two processes, other versions, other disks
def test_second_process_is_told_who_holds_the_workspace(bench: Bench) -> None:
    first = bench.process(TOY_SLEEP="20")
    try:
        scratch = bench.root / ".work" / "sfm" / "scratch" / "count"
        deadline = time.monotonic() + 20
        while not scratch.exists() and time.monotonic() < deadline:
            time.sleep(0.02)
        with pytest.raises(WorkspaceError, match=f"in use by process {first.pid} on ") as caught:
            bench.run()
        assert f"kill {first.pid}" in caught.value.hint
    finally:
        first.kill()
        first.communicate()
    assert "sfm" in bench.ran()  # a lock dies with its process


def test_newer_workspace_is_refused(bench: Bench) -> None:
    bench.run()
    path = bench.root / "workspace.json"
    record = json.loads(path.read_text())
    path.write_text(json.dumps({**record, "format": FORMAT + 1, "hineus": "9.0"}))
    with pytest.raises(WorkspaceError, match=f"has format {FORMAT + 1}, made by hineus 9.0"):
        bench.run()


def test_damaged_record_is_told(bench: Bench) -> None:
    bench.run()
    (bench.root / "workspace.json").write_text("{")
    with pytest.raises(WorkspaceError, match=r"workspace\.json is damaged"):
        bench.run()
    (bench.root / "workspace.json").unlink()  # as the hint says
    assert bench.ran() == {}


def test_folder_with_other_things_is_no_workspace(bench: Bench) -> None:
    bench.root.mkdir()
    (bench.root / "thesis.doc").write_text("")
    with pytest.raises(WorkspaceError, match=r"holds 1 other files or folders \(thesis.doc\)"):
        bench.run()


def test_read_only_workspace_is_told(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = os.open

    def refuse(path: Any, flags: int, *more: Any) -> int:
        if flags & os.O_RDWR:
            raise OSError(errno.EROFS, "Read-only file system", str(path))
        return opened(path, flags, *more)

    bench.run()
    monkeypatch.setattr(workspace_module.os, "open", refuse)
    with pytest.raises(WorkspaceError, match="cannot be written while opening the workspace: Read-only file system"):
        bench.run()


def test_full_disk_while_publishing_loses_nothing(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.run()
    original = workspace_module.write_own

    def full(path: Path, text: str) -> None:
        if path.name == MANIFEST:
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        original(path, text)

    with monkeypatch.context() as patch:
        patch.setattr(workspace_module, "write_own", full)
        patch.setattr(workspace_module, "free_bytes", lambda root: 12_345_678)
        with pytest.raises(WorkspaceError) as caught:
            bench.run(sets=("sfm.max_features=200",))
    assert "The disk is full while publishing 'sfm': 12.3 MB free" in caught.value.message
    assert "more needed" in caught.value.message
    assert bench.ran() == {}  # the publication before it is untouched
    assert "sfm" in bench.ran(sets=("sfm.max_features=200",))


@pytest.mark.parametrize(
    ("error", "free"),
    [
        (lambda: OSError(errno.ENOSPC, "No space left on device"), 10**9),
        (lambda: RuntimeError("PytorchStreamWriter failed writing file"), 1000),
    ],
)
def test_full_disk_while_a_stage_writes(bench: Bench, monkeypatch: pytest.MonkeyPatch, error: Any, free: int) -> None:
    monkeypatch.setattr(workspace_module, "free_bytes", lambda root: free)
    with pytest.raises(WorkspaceError, match="The disk is full while running 'sfm'"):
        bench.run(with_stage("sfm", run=failing(error)))
    assert bench.states()["ingest"].startswith("fresh")


# ---------------------------------------------------------------- sources and the machine
def test_photos_gone_are_no_loss_until_they_are_needed(bench: Bench, tmp_path: Path) -> None:
    bench.run()
    bench.photos.rename(tmp_path / "away")
    assert list(bench.ran(sets=("sfm.max_features=200",))) == ["sfm", "undistort", "export"]
    with pytest.raises(InputError, match="its photos are not at"):
        bench.run(force=("ingest",))


def test_digest_cache_reads_a_file_again_only_when_it_changed(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[str] = []

    def counting(path: Path) -> str:
        read.append(path.name)
        return file_sha256(path)

    monkeypatch.setattr("stages.engine.fingerprint.file_sha256", counting)
    long_ago = time.time() - 100
    for photo in bench.photos.iterdir():
        os.utime(photo, (long_ago, long_ago))
    cache = tmp_path / "cache.json"

    def digests() -> Any:
        sources = SourceDigests({"photos": bench.photos}, cache)
        files = sources.files("photos")
        sources.save()
        return files

    first = digests()
    assert read == ["IMG_0.jpg", "IMG_1.jpg", "IMG_2.jpg"]
    assert digests() == first
    assert len(read) == 3
    (bench.photos / "IMG_1.jpg").write_text("BANANA")  # same size; changed just now, so not remembered either
    assert digests() != first
    digests()
    assert read[3:] == ["IMG_1.jpg", "IMG_1.jpg"]
    cache.write_text("{")
    digests()
    assert len(read) == 8


def test_missing_system_library_names_the_package(bench: Bench) -> None:
    error = failing(lambda: OSError("libGL.so.1: cannot open shared object file: No such file or directory"))
    with pytest.raises(SystemRequirementError, match=r"needs the system library libGL\.so\.1") as caught:
        bench.run(with_stage("sfm", run=error))
    assert "apt-get install -y" in caught.value.hint
    assert "libgl1" in caught.value.hint


def test_missing_package_and_exhausted_memory_are_told(bench: Bench) -> None:
    missing = failing(lambda: ModuleNotFoundError("No module named 'xatlas'", name="xatlas"))
    with pytest.raises(SystemRequirementError, match="needs the Python package xatlas"):
        bench.run(with_stage("sfm", run=missing))
    with pytest.raises(SystemRequirementError, match="ran out of memory"):
        bench.run(with_stage("sfm", run=failing(MemoryError)))


def test_a_stage_s_own_error_reaches_the_caller(bench: Bench) -> None:
    with pytest.raises(HineusError, match="only 2 photos"):
        bench.run(with_stage("ingest", run=failing(lambda: InputError("only 2 photos", "take more"))))


# ---------------------------------------------------------------- what is recorded
def test_manifest_records_what_it_was_made_from(bench: Bench) -> None:
    bench.run()
    data = json.loads((bench.root / "sfm" / MANIFEST).read_text())
    ingest = json.loads((bench.root / "ingest" / MANIFEST).read_text())
    assert data["params"]["max_features"] == 8192
    assert data["inputs"] == {"ingest/letters.txt": ingest["outputs_digest"]}
    assert set(ingest["sources"]["photos"]) == {"IMG_0.jpg", "IMG_1.jpg", "IMG_2.jpg"}
    assert data["outputs"]["model/poses.txt"]["size"] == 3 * 81
    assert data["peak_rss"] > 1_000_000
    assert json.loads((bench.root / "export" / MANIFEST).read_text())["numbers"] == {"nan": None}


def test_settings_are_kept_and_can_be_fed_back(bench: Bench) -> None:
    bench.run(sets=("sfm.max_features=200", "train.minutes=1.5"), preset="tiny")
    config = load_config(file=bench.root / "config.yaml")
    assert config == load_config(sets=("sfm.max_features=200", "train.minutes=1.5"))
    assert Workspace.open(bench.root).record.preset == "tiny"
    assert Workspace.open(bench.root).record.sources["photos"] == str(bench.photos)


def test_manifest_round_trip_and_tampering() -> None:
    from stages.engine.fingerprint import Identity

    identity = Identity("sfm", 1, {"a": 1.5, "b": [1, 2]}, {"ingest": "x"}, {"photos": {"a.jpg": "h"}, "masks": None})
    manifest = Manifest(identity, {"f": OutputFile(3, "s")}, {"n": 1})
    assert Manifest.from_json(manifest.to_json()) == manifest
    with pytest.raises(ManifestDamaged):
        Manifest.from_json(manifest.to_json().replace('"a": 1.5', '"a": 1.6'))


@pytest.mark.slow
def test_meter_sees_memory_and_cpu_of_children() -> None:
    program = "b = bytearray(150_000_000); b[::4096] = b'x' * len(b[::4096]); import time; time.sleep(1)"
    with ResourceMeter() as meter:
        subprocess.run([sys.executable, "-c", program], check=True)
    assert meter.peak_rss > 150_000_000
    assert meter.cpu_s > 0.01
    assert meter.wall_s >= 1


def test_resolved_settings_are_plain_data(bench: Bench) -> None:
    assert "!!python" not in (bench.run() and bench.root / "config.yaml").read_text()
    assert isinstance(load_config(file=bench.root / "config.yaml"), Config)


def test_a_workspace_below_a_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "photo.jpg").write_bytes(b"")
    workspace = Workspace.open(tmp_path / "photo.jpg" / "ws", create=True)
    with pytest.raises(WorkspaceError, match=r"photo\.jpg/ws cannot be written") as caught, workspace.lock():
        pass
    assert "--workspace" in caught.value.hint


# ---------------------------------------------------------------- declared artifacts
def test_a_read_that_was_not_declared_is_refused(bench: Bench) -> None:
    def peek(context: StageContext) -> dict[str, Any]:
        context.write(MODEL, context.read(LETTERS))
        return {}

    with pytest.raises(ValueError, match=r"ingest/letters\.txt is read without being declared"):
        bench.run(with_stage("export", run=peek))
    bench.run(with_stage("export", run=peek, reads=(LETTERS,)))
    assert (bench.root / "export" / "model.glb").read_text() == "abc"


def test_what_is_published_is_what_was_declared(bench: Bench) -> None:
    def more(context: StageContext) -> dict[str, Any]:
        (context.out / "extra.txt").write_text("x")
        return {}

    with pytest.raises(ValueError, match=r"extra\.txt.* without declaring it, and did not write .*export/model\.glb"):
        bench.run(with_stage("export", run=more))
    assert bench.workspace.published("export") is None


def test_only_the_artifacts_that_are_read_make_a_stage_stale(bench: Bench) -> None:
    note = text_artifact("sfm", "note.txt")

    def noted(context: StageContext) -> dict[str, Any]:
        context.write(note, str(context.params.max_features))
        (context.out / "model").mkdir()
        context.write(POSES, context.read(LETTERS))
        return {}

    pipeline = with_stage("sfm", run=noted, writes=(POSES, note))
    bench.run(pipeline)
    assert list(bench.ran(pipeline, sets=("sfm.max_features=4096",))) == ["sfm"]  # the note changed, the poses did not
    reader = tuple(replace(stage, reads=(POSES, note)) if stage.name == "undistort" else stage for stage in pipeline)
    bench.run(reader, sets=("sfm.max_features=4096",))
    assert bench.ran(reader, sets=("sfm.max_features=2048",))["undistort"] == "input sfm/note.txt changed"


def test_a_stage_that_reads_manifests_or_the_run_follows_them(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, Any] = {}

    def look(context: StageContext) -> dict[str, Any]:
        seen.update(cost=context.manifests["sfm"].wall_s, record=context.record, config=context.config)
        context.write(MODEL, "seen")
        return {}

    pipeline = with_stage("export", run=look, reads_manifests=("sfm",), reads_run=True)
    bench.run(pipeline)
    assert seen["cost"] > 0
    assert seen["record"].sources["photos"] == str(bench.photos)
    assert seen["config"].sfm.max_features == 8192
    assert bench.ran(pipeline) == {}
    monkeypatch.setenv("TOY_SLEEP", "0.1")  # else it may cost the same to the millisecond, and its manifest be the same
    assert bench.ran(pipeline, force=["sfm"])["export"] == "sfm was made again"
    assert bench.ran(pipeline, sets=("report.thumbnails=7",)) == {"export": "the run was started otherwise"}
    assert seen["config"].report.thumbnails == 7


def test_a_workspace_of_the_first_version_goes_on(bench: Bench) -> None:
    """0.1.0 wrote one digest for all that a stage published, and had other names for some settings."""
    bench.run()
    for stage, before in (("sfm", "ingest"), ("undistort", "sfm"), ("export", "undistort")):
        manifest = bench.workspace.published(stage)
        digest = bench.workspace.published(before).outputs_digest
        params = {**manifest.identity.params, **({"gps": True} if stage == "undistort" else {})}  # now place.gps
        old = replace(manifest, identity=replace(manifest.identity, inputs={before: digest}, params=params))
        (bench.root / stage / MANIFEST).write_text(old.to_json())
    assert bench.ran() == {}
    for path in bench.photos.iterdir():
        path.write_text("other" + path.name)
    assert list(bench.ran()) == ["ingest", "sfm", "undistort"]


def test_many_reasons_are_counted() -> None:
    assert StageStatus("sfm", "stale", ("a", "b", "c")).reason == "a; b; c"
    assert StageStatus("sfm", "stale", ("a", "b", "c", "d", "e")).reason == "a; b; c; and 2 more"
    assert StageStatus("sfm", "fresh").reason == "nothing changed"


def test_a_warning_s_command_names_this_workspace(tmp_path: Path, caplog) -> None:
    def warning(context: StageContext) -> dict[str, Any]:
        numbers = TOY[1].run(context)
        return {**numbers, "warnings": [{"sentence": "A cut.", "command": "hineus run --workspace WORKSPACE --x"}]}

    photos = tmp_path / "photos"
    photos.mkdir()
    workspace = Workspace.open(tmp_path / "my work", create=True)
    run_pipeline(with_stage("sfm", run=warning), workspace, Config(), {"photos": photos, "masks": None})
    assert f"A cut. Try: `hineus run --workspace '{tmp_path}/my work' --x`" in caplog.text
    made = workspace.published("sfm")
    assert made is not None
    assert made.numbers["warnings"][0]["command"] == "hineus run --workspace WORKSPACE --x"


# ---------------------------------------------------------------- going on from the last publication
def _longer(context: StageContext) -> dict[str, Any]:
    """Adds a letter to what was published before, after a try that fails."""
    before = context.read_previous(POSES)
    tried = context.scratch / "tried"
    if (os.environ.get("TOY_FAIL"), tried.exists()) == ("once", False):
        tried.write_text("")
        raise ValueError("bad luck")
    (context.out / "model").mkdir()
    context.write(POSES, "first " if before is None else before + "x")
    return {"tried": tried.exists()}


GROWING = with_stage("sfm", run=_longer, continues=True)


def _poses(bench: Bench) -> str:
    return POSES.load(bench.root / "sfm")


def test_a_stage_goes_on_from_its_last_publication_and_says_so_in_its_manifest(bench: Bench) -> None:
    bench.run(GROWING)
    first = load_manifest(bench.root / "sfm")
    assert first is not None
    assert first.identity.previous is None
    assert "previous" not in first.identity.parts
    (bench.photos / "IMG_3.jpg").write_text("date")
    assert bench.ran(GROWING)["sfm"] == "input ingest/letters.txt changed"
    assert _poses(bench) == "first x"
    second = load_manifest(bench.root / "sfm")
    assert second is not None
    assert second.identity.previous == first.digest
    assert second.identity.fingerprint != replace(second.identity, previous=None).fingerprint
    assert bench.ran(GROWING) == {}
    assert bench.states()["sfm"] == "fresh: nothing changed"


@pytest.mark.parametrize("why", ["forced", "settings", "version", "damage", "a flipped bit", "not declared"])
def test_a_stage_starts_anew_where_its_last_publication_is_no_ground(bench: Bench, why: str) -> None:
    bench.run(GROWING)
    (bench.photos / "IMG_3.jpg").write_text("date")
    pipeline, options = GROWING, {}
    if why == "forced":
        options = {"force": ("sfm",)}
    elif why == "settings":
        options = {"sets": ("sfm.max_features=200",)}
    elif why == "version":
        pipeline = with_stage("sfm", run=_longer, continues=True, version=2)
    elif why == "damage":
        (bench.root / "sfm" / "model" / "poses.txt").unlink()
    elif why == "a flipped bit":
        (bench.root / "sfm" / "model" / "poses.txt").write_text("fIrst ")
    else:
        pipeline = with_stage("sfm", run=_longer)
    assert "sfm" in bench.ran(pipeline, **options)  # type: ignore[arg-type]
    assert _poses(bench) == "first "
    manifest = load_manifest(bench.root / "sfm")
    assert manifest is not None
    assert manifest.identity.previous is None


def test_a_stage_that_went_on_resumes_after_a_failure(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.run(GROWING)
    (bench.photos / "IMG_3.jpg").write_text("date")
    monkeypatch.setenv("TOY_FAIL", "once")
    with pytest.raises(ValueError, match="bad luck"):
        bench.run(GROWING)
    assert _poses(bench) == "first "  # what it goes on from is still there
    outcomes = {outcome.name: outcome for outcome in bench.run(GROWING)}
    assert outcomes["sfm"].numbers == {"tried": True}
    assert _poses(bench) == "first x"
