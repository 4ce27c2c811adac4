"""Machines that are not like ours: no home, nothing writable, containers' limits, other systems."""

from __future__ import annotations

import errno
import os
import stat
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import psutil
import pytest

import hineus_cli.__main__
from hineus_cli.__main__ import _bound_threads, leave_current_folder, shadowed
from stages import caches, children, limits, machine_check
from stages.engine import guard, run_log, workspace
from stages.engine.locking import take
from stages.engine.system import SYSTEM_LIBRARIES, missing_libraries
from stages.engine.workspace import storage_errors
from stages.errors import WorkspaceError
from stages.texture.charts import UvLayout, unwrap_uvatlas, unwrap_xatlas

REPOSITORY = Path(__file__).parents[1]
FULL = OSError(errno.ENOSPC, "No space left on device")


@pytest.fixture
def no_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's cache would lie below a file, so it cannot be made; the place of temporary files is empty."""
    (tmp_path / "file").touch()
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr(caches, "_user_cache", lambda: tmp_path / "file" / "hineus")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    caches.cache_folder.cache_clear()
    yield tmp_path / "temporary"
    caches.cache_folder.cache_clear()


@pytest.fixture(autouse=True)
def _forgotten() -> Iterator[None]:
    caches.system_temporary.cache_clear()
    yield
    caches.system_temporary.cache_clear()


# ---------------------------------------------------------------- a place for compiled code
def test_compiled_code_goes_to_the_users_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(caches, "_user_cache", lambda: tmp_path / "cache" / "hineus")
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    caches.cache_folder.cache_clear()
    assert caches.compiler_folder("NUMBA_CACHE_DIR", "numba") == tmp_path / "cache" / "hineus" / "numba"
    assert os.environ["NUMBA_CACHE_DIR"] == str(tmp_path / "cache" / "hineus" / "numba")
    assert stat.S_IMODE((tmp_path / "cache" / "hineus").stat().st_mode) == 0o700
    caches.cache_folder.cache_clear()


def test_numba_takes_no_settings_of_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / ".numba_config.yaml").write_text("disable_jit: 1", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    ended = children.run(children.program_command("import stages.compiling"), 60)
    assert ended.stderr.splitlines()[-1].startswith("stages.errors.InputError: Numba would take its settings from /")


def test_without_a_cache_it_goes_to_a_folder_of_this_user_alone(no_cache: Path) -> None:
    folder, remark = caches.cache_folder()
    assert folder == no_cache / f"hineus-{os.geteuid()}"
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert remark is not None
    assert "cannot be written" in remark


def test_a_user_without_a_home_has_a_cache(no_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> Path:
        raise RuntimeError("could not determine the home directory for '~/.cache'")

    monkeypatch.setattr(caches, "_user_cache", refuse)
    folder, remark = caches.cache_folder()
    assert folder.parent == no_cache
    assert remark is not None
    assert "home directory" in remark


@pytest.mark.parametrize("trap", ["others may write", "link", "file", "of another user"])
def test_a_folder_that_others_prepared_is_not_used(no_cache: Path, trap: str, monkeypatch: pytest.MonkeyPatch) -> None:
    planted = no_cache / f"hineus-{os.geteuid()}"
    if trap == "link":
        (no_cache / "elsewhere").mkdir(mode=0o700)
        planted.symlink_to(no_cache / "elsewhere")
    elif trap == "file":
        planted.touch()
    else:
        planted.mkdir()
        planted.chmod(0o777 if trap == "others may write" else 0o700)
    if trap == "of another user":
        owner = os.geteuid()
        planted.rename(no_cache / f"hineus-{owner + 1}")
        monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    folder, _ = caches.cache_folder()
    assert folder.parent == no_cache
    assert folder.name not in ("hineus-0", f"hineus-{os.geteuid()}")
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_a_variable_that_names_no_usable_folder_is_replaced(
    no_cache: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/proc/nowhere")
    assert caches.compiler_folder("NUMBA_CACHE_DIR", "numba").is_relative_to(no_cache)
    assert "NUMBA_CACHE_DIR cannot be used: /proc/nowhere cannot be written" in caplog.text
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(no_cache / "mine"))
    assert caches.compiler_folder("NUMBA_CACHE_DIR", "numba") == no_cache / "mine"


def test_a_full_quota_and_a_relative_cache_are_found_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "no absolute path" in (caches.why_unusable(Path("~/.cache")) or "")

    def refuse(*args: object, **named: object) -> None:
        raise FULL

    monkeypatch.setattr(tempfile, "TemporaryFile", refuse)
    assert "No space left on device" in (caches.why_unusable(tmp_path / "cache") or "")


@pytest.mark.slow
def test_kernels_compile_for_a_user_who_can_write_neither_home_nor_program(cases_dir: Path, tmp_path: Path) -> None:
    """Case 14, as in a container with `--user`."""
    if os.geteuid() != 0:
        pytest.skip("only root can become another user")
    program = (
        "import numpy as np; from stages.evaluation.thinning import thin; from stages import caches;"
        "print(caches.cache_folder()[0])"
    )
    (tmp_path / "t").mkdir()
    (tmp_path / "t").chmod(0o1777)
    settings = [f"PYTHONPATH={REPOSITORY}", f"TMPDIR={tmp_path / 't'}", "PYTHONDONTWRITEBYTECODE=1"]
    asuser = cases_dir / "14-no-numba-cache" / "asuser.sh"
    ended = subprocess.run(
        ["bash", asuser, *settings, sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.strip() == str(tmp_path / "t" / "hineus-23456")


# ---------------------------------------------------------------- temporary files
def test_temporary_files_lie_in_the_workspace_and_go_with_their_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", lambda: ["/proc/nowhere"])
    work = tmp_path / ".work"
    (work / "tmp-killed" / "atlas-x").mkdir(parents=True)
    (work / "sfm").mkdir()
    with caches.temporary_files(work):
        with tempfile.NamedTemporaryFile() as file:
            assert Path(file.name).is_relative_to(work)
        assert Path(os.environ["TMPDIR"]).is_relative_to(work)
        assert caches.system_temporary() is None
    assert os.listdir(work) == ["sfm"]


# ---------------------------------------------------------------- disks
def test_doctor_says_where_nothing_can_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert machine_check._disk(tmp_path / "not" / "yet").state == "ok"
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert "which cannot be written" in machine_check._disk(tmp_path).found


def test_a_quota_is_told_from_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (
        pytest.raises(WorkspaceError, match="Your quota is used up while writing"),
        storage_errors(tmp_path, "writing", needed=10),
    ):
        raise OSError(errno.EDQUOT, "Disk quota exceeded")
    monkeypatch.setattr(caches.shutil, "disk_usage", lambda path: SimpleNamespace(free=9))
    with (
        pytest.raises(WorkspaceError, match="A file became too large while writing"),
        storage_errors(tmp_path, "writing"),
    ):
        raise OSError(errno.EFBIG, "File too large")
    with pytest.raises(WorkspaceError, match="The disk is full"), storage_errors(tmp_path, "writing", needed=10):
        raise OSError(errno.ENOSPC, "No space left on device")


def test_a_limit_of_files_sizes_counts_as_a_full_disk_where_a_library_hides_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hidden = RuntimeError("No registered database factory succeeded.")
    (tmp_path / ".work").mkdir()
    (tmp_path / ".work" / "database").write_bytes(bytes(2_000_000))
    monkeypatch.setattr(workspace, "largest_file", lambda: 9_000_000)
    assert not workspace.is_disk_full(hidden, tmp_path)
    for limit in (2_001_000, 4096):
        monkeypatch.setattr(workspace, "largest_file", lambda limit=limit: limit)
        assert workspace.is_disk_full(hidden, tmp_path)
        assert "ulimit -f" in workspace.disk_full_error(tmp_path, "running 'sfm'", hidden).hint


def test_a_log_that_cannot_be_written_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: str, flags: int) -> int:
        raise PermissionError(errno.EPERM, "Operation not permitted", path)

    monkeypatch.setattr(run_log, "open_own", refuse)
    with (
        pytest.raises(WorkspaceError, match="cannot be written while opening its log"),
        run_log.log_to_file(tmp_path / "hineus.log"),
    ):
        pass


# ---------------------------------------------------------------- containers' limits
LIMITED = {
    "version 2": (
        "0::/box\n",
        {
            "box/cpu.max": "150000 100000\n",
            "box/memory.max": "max\n",
            "box/memory.current": "5\n",
            "memory.max": "4000\n",
            "memory.current": "3000\n",
            "memory.stat": "anon 2000\ninactive_file 500\nactive_file 200\nfile_mapped 200\n",
        },
    ),
    "version 1, of a path that only the host sees": (
        "4:memory:/docker/abc\n3:cpu,cpuacct:/docker/abc\n0::/\n",
        {
            "cpu/cpu.cfs_quota_us": "150000\n",
            "cpu/cpu.cfs_period_us": "100000\n",
            "memory/memory.limit_in_bytes": "4000\n",
            "memory/memory.usage_in_bytes": "3000\n",
            "memory/memory.stat": "cache 7\ntotal_inactive_file 500\n",
        },
    ),
}


def control_groups(folder: Path, own: str, files: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    for name, text in files.items():
        (folder / "groups" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "groups" / name).write_text(text)
    (folder / "own").write_text(own)
    monkeypatch.setattr(limits, "CONTROL_GROUPS", folder / "groups")
    monkeypatch.setattr(limits, "OWN_GROUPS", folder / "own")
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)), raising=False)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=6000, total=9000))


@pytest.mark.parametrize("version", LIMITED)
def test_a_containers_quota_of_cores_and_memory_counts(
    version: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    control_groups(tmp_path, *LIMITED[version], monkeypatch)
    assert limits.available_cores() == 2  # one and a half
    assert limits.available_memory() == 1500
    assert limits.total_memory() == 4000
    assert machine_check._cores().found.startswith("2 usable of ")


@pytest.mark.parametrize(
    ("own", "files"),
    [
        ("0::/box\n", {"box/cpu.max": "max 100000\n", "memory.max": "max\n", "memory.current": "5\n"}),
        ("2:cpu:/\n1:memory:/\n", {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}),
        ("", {}),
    ],
)
def test_without_limits_the_machine_counts(
    own: str, files: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    control_groups(tmp_path, own, files, monkeypatch)
    assert (limits.available_cores(), limits.available_memory(), limits.total_memory()) == (8, 6000, 9000)


def test_without_affinity_all_cores_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    control_groups(tmp_path, "", {}, monkeypatch)
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    assert limits.available_cores() == 3


@pytest.mark.skipif(sys.platform != "linux", reason="limits of address space are told on Linux")
def test_ulimit_counts(tmp_path: Path) -> None:
    program = (
        "import resource; from stages import limits; resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30));"
        "print(limits.total_memory() == 1 << 30, 0 < limits.available_memory() < 1 << 30)"
    )
    command = [sys.executable, "-c", program]
    ended = subprocess.run(command, capture_output=True, text=True, cwd=REPOSITORY, check=True)
    assert ended.stdout == "True True\n"


@pytest.mark.skipif(sys.platform != "linux", reason="control groups are Linux'")
def test_what_a_container_has_not_left_is_not_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "container_memory_left", lambda: 200_000_000)
    with guard.allocations_end_at_the_limit():
        np.empty(50_000_000, np.uint8)
        with pytest.raises(MemoryError):
            np.empty(2_000_000_000, np.uint8)
    np.empty(2_000_000_000, np.uint8)
    monkeypatch.setattr(guard, "container_memory_left", lambda: None)
    with guard.allocations_end_at_the_limit():
        np.empty(2_000_000_000, np.uint8)


def test_libraries_start_no_more_threads_than_the_container_has_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "available_cores", lambda: 1)
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setenv("OMP_NUM_THREADS", "2")  # somebody's own choice stays
    monkeypatch.setenv("NUMBA_NUM_THREADS", "3")  # so that it is put back, where it was not set either
    monkeypatch.delenv("NUMBA_NUM_THREADS")
    _bound_threads()
    assert (os.environ["OMP_NUM_THREADS"], os.environ["NUMBA_NUM_THREADS"]) == ("2", "1")


# ---------------------------------------------------------------- other systems
# Twice: what others import is there when ours are to do without.
WITHOUT_POSIX = """
import importlib, pkgutil, sys

def import_all():
    for name in {packages}:
        for module in pkgutil.walk_packages(importlib.import_module(name).__path__, name + "."):
            if module.name.split(".")[-1] not in ("encoding_cuda", "__main__"):
                importlib.import_module(module.name)

import_all()
for name in list(sys.modules):
    if name.split(".")[0] in ("configs", "stages", "hineus_cli"):
        del sys.modules[name]
sys.platform = "win32"
for name in ("fcntl", "resource", "pwd", "grp", "termios"):
    sys.modules[name] = None
import_all()
print("imported")
"""


@pytest.mark.parametrize(
    "packages", [["configs", "stages.engine", "hineus_cli"], pytest.param(["stages"], marks=pytest.mark.slow)]
)
def test_modules_import_without_what_only_posix_has(packages: list[str], tmp_path: Path) -> None:
    ended = subprocess.run(
        [sys.executable, "-c", WITHOUT_POSIX.format(packages=packages)],
        capture_output=True,
        text=True,
        cwd=REPOSITORY,
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},  # the system's own place would be Windows'
        check=False,
    )
    assert ended.stdout == "imported\n", ended.stderr


def test_windows_locks_a_byte_behind_the_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[tuple[int, int]] = []

    def locking(descriptor: int, mode: int, count: int) -> None:
        if taken:
            raise PermissionError(13, "Permission denied")
        taken.append((os.lseek(descriptor, 0, os.SEEK_CUR), count))

    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(locking=locking, LK_NBLCK=2))
    descriptor = os.open(tmp_path / "lock", os.O_RDWR | os.O_CREAT)
    take(descriptor)
    with pytest.raises(BlockingIOError):
        take(descriptor)
    os.close(descriptor)
    assert taken == [(1 << 30, 1)]


def test_only_linux_lacks_system_libraries(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    assert missing_libraries() == []
    assert machine_check._system_libraries(broken=False).found == "the packages bring theirs"


def test_every_file_can_lie_on_windows_and_macos() -> None:
    """Their file systems take upper and lower case for the same, and Windows refuses some names."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    names = listed.stdout.split("\0")[:-1]
    assert len(names) > 100
    assert [name for name, count in Counter(name.lower() for name in names).items() if count > 1] == []
    reserved = {"con", "prn", "aux", "nul", *(f"{port}{number}" for port in ("com", "lpt") for number in range(1, 10))}
    parts = {part for name in names for part in name.split("/")}
    assert [part for part in parts if part.split(".")[0].lower() in reserved or set(part) & set('<>:"|?*\\')] == []
    assert max(len(name) for name in names) < 150  # of the 260 that Windows has for a whole path


# ---------------------------------------------------------------- modules of common names
def test_another_package_of_the_same_name_is_found_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert shadowed(str(REPOSITORY)) is None
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs" / "__init__.py").touch()
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{REPOSITORY}")
    version = [sys.executable, "-m", "hineus_cli", "--version"]
    ended = subprocess.run(version, capture_output=True, text=True, cwd=REPOSITORY.parent, check=False)
    assert ended.returncode == 1
    assert ended.stderr.startswith(f"Error: {str(tmp_path / 'configs')!r} is found instead of our part")
    assert "Traceback" not in ended.stderr


@pytest.mark.parametrize(
    ("folder", "named", "stays"),
    [("photos", "", False), ("photos", ":/elsewhere", False), ("photos", "photos", True), ("home", "", True)],
    ids=["of somebody else", "an empty entry", "named in full", "ours"],
)
def test_the_current_folder_is_in_the_path_only_on_purpose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str, named: str, stays: bool
) -> None:
    here = tmp_path / folder
    here.mkdir()
    monkeypatch.chdir(here)
    monkeypatch.setattr(hineus_cli.__main__, "HOME", str(tmp_path / "home"))
    monkeypatch.setenv("PYTHONPATH", str(here) if named == folder else named)
    monkeypatch.setattr(sys, "path", [str(here), "/elsewhere"])
    leave_current_folder()
    assert sys.path == [str(here), "/elsewhere"] if stays else ["/elsewhere"]


@pytest.fixture
def ran(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder is somebody else's, whose modules have names that we import: a file that they make if run."""
    ran, folder = tmp_path / "ran", tmp_path / "planted"
    folder.mkdir()
    installed = ("numpy", "torch", "cv2", "open3d", "xatlas", "numba", "trimesh", "typer", "yaml", "pydantic")
    for name in (*installed, "secrets", "uuid", "colorsys"):  # and of Python's own, such as are imported late
        (folder / f"{name}.py").write_text(f"open({str(ran)!r}, 'a').write(__name__ + ' ')", encoding="utf-8")
    monkeypatch.chdir(folder)
    monkeypatch.setenv("PYTHONPATH", f"{os.pathsep}{REPOSITORY}")
    return ran


@pytest.mark.parametrize(
    "arguments", [["--version"], ["presets"], pytest.param(["doctor"], marks=pytest.mark.slow)], ids=lambda a: a[0]
)
def test_a_command_runs_no_code_of_the_current_folder(ran: Path, arguments: list[str]) -> None:
    command = [sys.executable, "-m", "hineus_cli", *arguments]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert not ran.exists()


def test_a_child_runs_no_code_of_the_current_folder(ran: Path) -> None:
    ended = children.run(children.program_command("import numpy, secrets; print(numpy.pi)"), 60)
    assert ended.stdout == "3.141592653589793\n", ended.stderr
    assert not ran.exists()


@pytest.mark.parametrize("unwrap", [pytest.param(unwrap_uvatlas, marks=pytest.mark.slow), unwrap_xatlas])
def test_charts_run_no_code_of_the_current_folder(ran: Path, unwrap: Callable[..., UvLayout]) -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float64)
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], dtype=np.int32)
    layout = unwrap(vertices, faces, 64, 2, 60)
    assert len(layout.faces) == 4
    assert not ran.exists()


def test_a_child_finds_what_this_process_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What it has from PYTHONPATH or of the user's own packages, which isolated interpreters leave out."""
    (tmp_path / "their_own.py").write_text("print('found')", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    assert children.run(children.program_command("import stages, their_own"), 60).stdout == "found\n"


@pytest.mark.skipif(sys.platform == "win32", reason="it has no limit of CPU time")
def test_a_module_is_stopped_by_its_cpu_time_and_not_while_it_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "waits.py").write_text("import time; time.sleep(0.5); print('done')", encoding="utf-8")
    (tmp_path / "works.py").write_text("while True: pass", encoding="utf-8")
    (tmp_path / "hangs.py").write_text("import time; time.sleep(60)", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    assert children.run_module("waits", cpu_limit=0.3).stdout == "done\n"
    with pytest.raises(subprocess.TimeoutExpired, match=r"after 0\.3 seconds"):
        children.run_module("works", cpu_limit=0.3)
    with pytest.raises(subprocess.TimeoutExpired):
        children.run_module("hangs", cpu_limit=0.5 / children.PATIENCE)


def test_doctor_names_packages_that_share_our_modules_names(monkeypatch: pytest.MonkeyPatch) -> None:
    owners = {"stages": ["hineus", "stages-of-grief"], "configs": ["hineus"], "numpy": ["numpy"]}
    monkeypatch.setattr(machine_check.metadata, "packages_distributions", lambda: owners)
    finding = machine_check._names()
    assert finding.state == "note"
    assert finding.found == "other packages have the same: stages (of stages-of-grief)"


def test_doctor_looks_at_every_dependency() -> None:
    tomllib = pytest.importorskip("tomllib")  # Python 3.11

    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    names = {requirement.split(">")[0] for requirement in project["dependencies"]}
    assert names == set(machine_check.REQUIRED.values())
    extras = project["optional-dependencies"]
    for_users = {
        each.split(">")[0] for name in extras for each in extras[name] if name not in ("dev", "bench", "triton")
    }
    assert for_users == {distribution for distribution, _ in machine_check.OPTIONAL.values()}
    # the image is for one CPU machine: what `splats` brings is for GPUs, and `cluster` starts other processes
    in_image = [name for name in extras if name not in ("dev", "bench", "triton", "splats", "cluster")]
    container = (REPOSITORY / "Dockerfile").read_text(encoding="utf-8")
    assert f"ARG EXTRAS={','.join(in_image)}\n" in container
    assert all(package in container for package in SYSTEM_LIBRARIES.values())
