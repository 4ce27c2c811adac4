"""What is installed: all that the program reads, and nothing that is not ours."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
PACKAGES = ("hineus_cli/", "stages/", "configs/")
BUILD = "import sys; from setuptools import build_meta as b; to = sys.argv[1]; b.build_wheel(to); b.build_sdist(to)"

pytestmark = pytest.mark.slow


def tracked() -> list[str]:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    return listed.stdout.split("\0")[:-1]


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with wheel and sdist, built of a copy of what is tracked: a build writes beside its source."""
    pytest.importorskip("setuptools", minversion="77")
    folder = tmp_path_factory.mktemp("build")
    for name in tracked():
        if (REPOSITORY / name).is_file():
            (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(REPOSITORY / name, folder / "source" / name)
    subprocess.run(
        [sys.executable, "-c", BUILD, str(folder)], cwd=folder / "source", capture_output=True, text=True, check=True
    )
    return folder


def wheel_of(folder: Path) -> zipfile.ZipFile:
    return zipfile.ZipFile(next(folder.glob("*.whl")))


def test_the_wheel_holds_what_is_tracked_of_our_packages_and_no_more(built: Path) -> None:
    with wheel_of(built) as wheel:
        held = {name for name in wheel.namelist() if ".dist-info/" not in name}
        top = wheel.read(next(name for name in wheel.namelist() if name.endswith("top_level.txt"))).decode().split()
        licences = [name for name in wheel.namelist() if name.endswith("licenses/LICENSE")]
    assert held == {name for name in tracked() if name.startswith(PACKAGES)}
    assert sorted(top) == sorted(package.strip("/") for package in PACKAGES)
    assert len(licences) == 1


def test_the_sdist_builds_and_holds_no_photos_and_results(built: Path) -> None:
    with tarfile.open(next(built.glob("*.tar.gz"))) as archive:
        names = [member.name.partition("/")[2] for member in archive.getmembers() if member.isfile()]
    assert {name for name in tracked() if name.startswith(PACKAGES)} <= set(names)
    assert {"pyproject.toml", "README.md", "LICENSE"} <= set(names)
    assert [name for name in names if name.startswith(("benchmarks/", "docs/", ".ci/", "demo/"))] == []


def test_an_installed_wheel_works_without_the_clone(built: Path, tmp_path: Path) -> None:
    """Unpacked, as pip does; what it needs is taken from here."""
    with wheel_of(built) as wheel:
        wheel.extractall(tmp_path / "site")
    program = (
        "import sys; sys.path.insert(0, sys.argv[1]); from importlib import resources\n"
        "from configs.load import load_config, preset_names\n"
        "from stages.evaluation.suites.paper import paper_tables\n"
        "import stages; paper_tables()\n"
        "assert stages.__file__.startswith(sys.argv[1]), stages.__file__\n"
        "for name in preset_names(): load_config(name)\n"
        "for name in ('neus2', 'hfneus', 'neuralangelo'): load_config(None, None, [f'train.backbone={name}'])\n"
        "scripts = ('viewer', 'region', 'splats', 'photos', 'vendor/three.min', 'vendor/spark.min')\n"
        "pages = ('live.html', 'blocks.html', 'watching.css', 'watching.js', 'report.html.j2')\n"
        "for name in (*pages, *(f'{script}.js' for script in scripts)):\n"
        "    assert resources.files('stages').joinpath('templates', name).read_text(encoding='utf-8')\n"
        "print('all there')"
    )
    ended = subprocess.run(
        [sys.executable, "-I", "-c", program, str(tmp_path / "site")], capture_output=True, text=True, check=False
    )
    assert ended.stdout == "all there\n", ended.stderr
