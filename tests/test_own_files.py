"""A workspace from somebody else: what lies where files of ours should, and records that say anything at all."""

from __future__ import annotations

import json
import logging
import os
import shutil
import socket
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from toy_pipeline import TOY
from typer.testing import CliRunner

from configs.params import Config
from hineus_cli.app import build_app
from stages import artifacts
from stages.artifacts import ImageRecord, ImageSet
from stages.artifacts.own_files import MOST_BYTES, stays_inside
from stages.engine.fingerprint import Identity
from stages.engine.manifest import Manifest, ManifestDamaged, OutputFile, load_manifest
from stages.engine.runner import run_pipeline
from stages.engine.workspace import Workspace
from stages.errors import WorkspaceError

pytestmark = pytest.mark.skipif(os.name == "nt", reason="links need a right there, and there are no pipes")

PIPELINE = (*TOY[:3], replace(TOY[3], name="report"))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A finished workspace, beside its photos and things that are none of its business."""
    (tmp_path / "photos").mkdir()
    for index, text in enumerate(["apple", "banana"]):
        (tmp_path / "photos" / f"{index}.jpg").write_text(text)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "precious.txt").write_text("precious")
    root = tmp_path / "ws"
    run_pipeline(TOY, Workspace.open(root, create=True), Config(), {"photos": tmp_path / "photos", "masks": None})
    (root / "hineus.log").write_text("")
    (root / ".work" / "sfm" / "scratch").mkdir()
    (root / ".work" / "sfm" / "scratch" / "count").write_text("1")
    return root


def invoke(*words: str | Path) -> tuple[int, str]:
    """Exit code, and what was said on stderr."""
    result = CliRunner().invoke(build_app(TOY), [str(word) for word in words])
    assert "Unexpected" not in result.stderr
    assert "Traceback" not in result.stderr
    return result.exit_code, " ".join(result.stderr.split())


def elsewhere(root: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in (root.parent / "elsewhere").iterdir()}


# ---------------------------------------------------------------- links, pipes and sockets
def _to_a_file(place: Path, outside: Path) -> None:
    place.symlink_to(outside / "precious.txt")


def _to_a_folder(place: Path, outside: Path) -> None:
    place.symlink_to(outside)


def _to_nothing(place: Path, outside: Path) -> None:
    place.symlink_to(outside / "new.txt")


def _to_itself(place: Path, outside: Path) -> None:
    place.symlink_to(place)


def _pipe(place: Path, outside: Path) -> None:
    os.mkfifo(place)


def _socket(place: Path, outside: Path) -> None:
    here = Path.cwd()
    os.chdir(place.parent)  # a socket's path may have some 100 bytes
    try:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(place.name)
    finally:
        os.chdir(here)


FOREIGN = (_to_a_file, _to_a_folder, _to_nothing, _to_itself, _pipe, _socket)
FILES = (".lock", "hineus.log", "workspace.json", "config.yaml", "workspace.json.tmp", "config.yaml.tmp")
PLACES = (
    *FILES, ".work", ".work/source_digests.json", ".work/sfm", ".work/sfm/scratch", ".work/sfm/scratch/count",
    ".work/sfm/out", "sfm", "sfm/manifest.json", "sfm/model", "sfm/model/poses.txt",
)  # fmt: skip


@pytest.mark.parametrize("put", FOREIGN)
@pytest.mark.parametrize("name", PLACES)
def test_what_is_no_file_of_ours_is_refused_by_name(root: Path, name: str, put: Callable[[Path, Path], None]) -> None:
    place, outside = root / name, root.parent / "elsewhere"
    shutil.rmtree(place, ignore_errors=True)
    place.unlink(missing_ok=True)
    put(place, outside)
    before = elsewhere(root)
    for command in (("status", root), ("view", root, "--no-browser"), ("run", "-w", root, "--until", "sfm")):
        code, said = invoke(*command)
        assert code == 5
        assert name in said
        assert "is a link" in said or "is a pipe, a socket or a device" in said
    assert elsewhere(root) == before


@pytest.mark.parametrize("name", [".lock", "hineus.log", ".work/sfm/scratch/count"])
def test_a_second_name_of_a_file_elsewhere_is_not_written(root: Path, name: str) -> None:
    (root / name).unlink()
    os.link(root.parent / "elsewhere" / "precious.txt", root / name)
    code, said = invoke("run", "-w", root, "--until", "sfm")
    assert code == 5
    assert f"{name} has 2 names" in said
    assert elsewhere(root) == {"precious.txt": "precious"}
    assert invoke("status", root)[0] == 0  # as that of a backup that is made of hard links


@pytest.mark.parametrize("name", FILES)
def test_a_folder_where_a_file_belongs_is_refused(root: Path, name: str) -> None:
    (root / name).unlink(missing_ok=True)
    (root / name).mkdir()
    for command in ("status", "run"):
        code, said = invoke(command, *(("-w",) if command == "run" else ()), root)
        assert code == 5
        assert f"{name} is a folder where a file" in said


def test_a_file_where_the_folder_of_work_belongs_is_refused(root: Path) -> None:
    shutil.rmtree(root / ".work")
    (root / ".work").write_text("")
    assert invoke("run", "-w", root) == (5, invoke("status", root)[1])
    assert ".work is a file where a folder" in invoke("status", root)[1]


def test_a_workspace_reached_through_a_link_is_fine(root: Path) -> None:
    link = root.parent / "link"
    link.symlink_to(root)
    assert invoke("status", link)[0] == 0
    assert invoke("run", "-w", link)[0] == 0
    (root / "notes.txt").symlink_to(root.parent / "elsewhere" / "precious.txt")  # no name of ours
    assert invoke("run", "-w", link, "--force", "sfm")[0] == 0


def test_links_in_the_temporary_files_of_a_killed_run_are_nobody_s_concern(root: Path) -> None:
    (root / ".work" / "tmp-abc").mkdir()
    (root / ".work" / "tmp-abc" / "video.mp4").symlink_to(root.parent / "elsewhere")
    assert invoke("run", "-w", root)[0] == 0


# ---------------------------------------------------------------- records
DEEP = b"[" * 100_000
JUNK = (
    b"", b"[]", b"null", b"5", b"{", b"\xff", b"\xff\xfe{\x00}\x00", b"\x00" * 50, DEEP, b'{"a":' * 100_000,
    b"NaN", b"9" * 5000, b"{}", b'{"\\ud800": "\\udfff"}',
)  # fmt: skip


@pytest.mark.parametrize("name", ["workspace.json", ".lock", ".work/sfm/scratch.json", ".work/source_digests.json"])
@pytest.mark.parametrize("junk", JUNK)
def test_a_record_of_junk_is_told_or_made_anew(root: Path, name: str, junk: bytes) -> None:
    (root / name).write_bytes(junk)
    expected = 5 if name == "workspace.json" else 0
    for command in (("status", root), ("run", "-w", root, "--force", "sfm")):
        code, said = invoke(*command)
        assert code == expected
        assert expected == 0 or "workspace.json is damaged" in said


@pytest.mark.parametrize(
    "changes",
    [
        {"format": None}, {"format": "x"}, {"format": 1e999}, {"format": []}, {"format": 10**400},
        {"sources": []}, {"sources": [1]}, {"sources": "photos"}, {"sources": {"photos": 5}},
        {"sources": {"photos": {}}}, {"sources": {"photos": ""}}, {"sources": {"photos": "../photos"}},
        {"sources": {"photos": "/a\0b"}}, {"sources": {"photos": True}},
    ],
)  # fmt: skip
def test_a_workspace_s_record_with_other_types_is_told(root: Path, changes: dict[str, object]) -> None:
    path = root / "workspace.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))
    for command in (("status", root), ("view", root), ("run", "-w", root)):
        assert invoke(*command)[0] == 5


@pytest.mark.parametrize(
    "place", ["/\ud800", "/" + "a" * 5000, "/dev/null/photos"], ids=["surrogate", "long", "below a device"]
)
def test_photos_that_cannot_be_anywhere_are_gone(root: Path, place: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logging.root.manager, "disable", logging.CRITICAL)  # xdist cannot send a log with such names
    path = root / "workspace.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "sources": {"photos": place}}))
    assert invoke("status", root)[0] == 0
    assert invoke("run", "-w", root)[0] in (0, 3)


@pytest.mark.parametrize("pid", [-1, 0, 2**31, 2**70, 1e999, None, "x", [], 1e30])
def test_a_lock_of_no_process_is_nobody_s(root: Path, pid: object) -> None:
    (root / ".lock").write_text(json.dumps({"pid": pid, "host": socket.gethostname(), "since": ""}))
    assert not Workspace.open(root).in_use()
    assert invoke("run", "-w", root)[0] == 0


@pytest.mark.parametrize("name", ["workspace.json", ".lock", "sfm/manifest.json", ".work/sfm/scratch.json"])
def test_a_huge_record_is_not_read(root: Path, name: str) -> None:
    (root / name).touch()
    os.truncate(root / name, MOST_BYTES * 1000)  # takes no place on the disk
    code, said = invoke("status", root)
    assert (code, f"at most {MOST_BYTES:,} are read" in said) in ((5, True), (0, False))
    assert code == (5 if name in ("workspace.json", "sfm/manifest.json") else 0)


@pytest.mark.parametrize("junk", JUNK)
def test_a_manifest_of_junk_is_never_trusted(root: Path, junk: bytes) -> None:
    (root / "sfm" / "manifest.json").write_bytes(junk)
    assert invoke("status", root)[0] == 0
    assert invoke("run", "-w", root)[0] == 0
    assert load_manifest(root / "sfm") is not None


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("numbers", {"sharp": "very"}), ("wall_s", 1e3), ("peak_rss", 5), ("versions", {"a": "9"}), ("created", ""),
        ("numbers", []), ("wall_s", "long"), ("outputs", []), ("sources", {"photos": 5}), ("inputs", {"a": 1}),
    ],
)  # fmt: skip
def test_a_manifest_that_was_changed_is_damaged(root: Path, key: str, value: object) -> None:
    path = root / "sfm" / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    with pytest.raises(ManifestDamaged):
        load_manifest(path.parent)


def test_a_manifest_without_a_checksum_is_an_older_version_s(root: Path) -> None:
    path = root / "sfm" / "manifest.json"
    data = json.loads(path.read_text())
    del data["checksum"]
    path.write_text(json.dumps(data))
    assert load_manifest(path.parent) is not None


@pytest.mark.parametrize("output", ["../../elsewhere/precious.txt", "/dev/zero", "..", "", "a/../../b", "a\0b"])
def test_a_manifest_names_nothing_outside_its_folder(output: str) -> None:
    text = Manifest(Identity("sfm", 1, {}), {output: OutputFile(8, "0" * 64)}).to_json()
    with pytest.raises(ManifestDamaged, match="leads out of its folder"):
        Manifest.from_json(text)


def test_a_manifest_of_another_stage_is_damaged(root: Path) -> None:
    shutil.copyfile(root / "ingest" / "manifest.json", root / "sfm" / "manifest.json")
    with pytest.raises(ManifestDamaged, match="it is of stage ingest"):
        Workspace.open(root).published("sfm")


def test_pictures_lie_in_their_folder(tmp_path: Path) -> None:
    pictures = artifacts.PHOTOS.load(tmp_path)
    assert pictures.path("a/b..jpg") == tmp_path / "images" / "a" / "b..jpg"
    for name in ("../x.jpg", "/x.jpg", "a/../../x.jpg"):
        with pytest.raises(WorkspaceError, match="names the file"):
            pictures.path(name)
        with pytest.raises(WorkspaceError, match="names the file"):
            pictures.mask_path(name)
    assert not stays_inside(".")


def test_the_list_of_photos_is_checked(tmp_path: Path) -> None:
    photo = ImageRecord("a.jpg", "a.jpg", 4, 3, 50.0, "0", 1.0, False, "0" * 64, frame="f", taken=(8, 6))
    artifacts.IMAGE_SET.save(tmp_path, ImageSet((photo,)))
    assert artifacts.IMAGE_SET.load(tmp_path) == ImageSet((photo,))
    good = json.loads((tmp_path / "images.json").read_text())
    for key, value in (("name", "../a.jpg"), ("width", "wide"), ("focal_px", 1e999), ("gps", [1]), ("more", 1)):
        images = [{**good["images"][0], key: value}]
        (tmp_path / "images.json").write_text(json.dumps({**good, "images": images}))
        with pytest.raises(WorkspaceError, match=rf"images\.json cannot be read.*{key}"):
            artifacts.IMAGE_SET.load(tmp_path)
    for junk in JUNK:
        (tmp_path / "images.json").write_bytes(junk)
        with pytest.raises(WorkspaceError, match="cannot be read"):
            artifacts.IMAGE_SET.load(tmp_path)
