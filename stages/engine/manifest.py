"""The manifest: the last file a stage's folder gets, so a folder without a valid one was never published."""

from __future__ import annotations

import json
import platform
import stat
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from datetime import datetime, timezone
from functools import lru_cache
from pathlib import Path
from typing import Any

from pydantic import ConfigDict, ValidationError

from stages.artifacts.artifact import Artifact
from stages.artifacts.json_files import PathInside, Record, first_problem
from stages.artifacts.own_files import read_own
from stages.engine.fingerprint import FileDigests, Identity, digest, file_sha256
from stages.engine.system import installed_version

MANIFEST = "manifest.json"
CHEAP_BYTES = 1 << 24  # of a publication are read back at each look: it takes a hundredth of a second

RECORDED_PACKAGES = (
    "hineus",
    "numpy",
    "torch",
    "pycolmap",
    "open3d",
    "pymeshlab",
    "trimesh",
    "opencv-python-headless",
)


class ManifestDamaged(ValueError):  # noqa: N818 - it names the state of the file
    """The file is there but is not a manifest that was written whole."""


@dataclass(frozen=True)
class OutputFile:
    """One published file: its size in bytes and the sha256 of its contents."""

    size: int
    sha256: str


@dataclass(frozen=True)
class Manifest:
    """What was published, from what, and at what cost.

    Attributes:
        identity: all the result depends on; its fingerprint decides whether it is still good.
        outputs: relative posix path -> size and hash.
        numbers: what the stage returned.
        wall_s, cpu_s: seconds; cpu_s is user + system, of this process and the children it waited for.
        peak_rss: bytes, the highest sum over the process and its children while the stage ran.
        versions: Python, platform and library versions.
        created: UTC time of publication, ISO 8601.
    """

    identity: Identity
    outputs: Mapping[str, OutputFile]
    numbers: Mapping[str, Any] = field(default_factory=dict)
    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_rss: int = 0
    versions: Mapping[str, str] = field(default_factory=dict)
    created: str = ""

    @property
    def outputs_digest(self) -> str:
        """One hash of all outputs."""
        return digest({path: file.sha256 for path, file in self.outputs.items()})

    @property
    def digest(self) -> str:
        """Of what it was made from and what came out."""
        return digest([self.identity.fingerprint, self.outputs_digest])

    def artifact_digest(self, artifact: Artifact[Any]) -> str:
        """One hash of an artifact's files: what the stages that read it depend on."""
        return digest({path: file.sha256 for path, file in self.outputs.items() if artifact.covers(path)})

    @property
    def size(self) -> int:
        """Bytes of all outputs."""
        return sum(file.size for file in self.outputs.values())

    def to_json(self, sealed: bool = False) -> str:
        """As text; `sealed` with a checksum of all of it, as it is published."""
        identity = self.identity
        data = {
            "stage": identity.stage,
            "version": identity.version,
            "fingerprint": identity.fingerprint,
            "parts": identity.parts,
            "params": jsonable(identity.params),
            "inputs": dict(identity.inputs),
            "sources": dict(identity.sources),
            "previous": identity.previous,
            "outputs": {path: asdict(file) for path, file in self.outputs.items()},
            "outputs_digest": self.outputs_digest,
            "numbers": jsonable(self.numbers),
            "wall_s": round(self.wall_s, 3),
            "cpu_s": round(self.cpu_s, 3),
            "peak_rss": int(self.peak_rss),
            "versions": dict(self.versions),
            "created": self.created,
        }
        seal = {"checksum": digest(data)} if sealed else {}
        return json.dumps(data | seal, indent=1, allow_nan=False) + "\n"

    @staticmethod
    def from_json(text: str | bytes) -> Manifest:
        """Raises ManifestDamaged where the text is not one, or does not agree with its own hashes."""
        try:
            read = _Written.model_validate_json(text)
        except ValidationError as error:
            raise ManifestDamaged(f"not a manifest: {first_problem(error)}") from error
        identity = Identity(read.stage, read.version, read.params, read.inputs, read.sources, read.previous)
        manifest = Manifest(
            identity,
            read.outputs,
            read.numbers,
            read.wall_s,
            read.cpu_s,
            read.peak_rss,
            read.versions,
            read.created,
        )
        data = json.loads(text)
        checksum = data.pop("checksum", None)  # the first manifests have none
        agrees = manifest.identity.fingerprint == read.fingerprint and manifest.outputs_digest == read.outputs_digest
        if not agrees or checksum not in (None, digest(data)):
            raise ManifestDamaged("its hashes do not agree with its contents")
        return manifest


class _Written(Record):
    """A manifest as it lies on the disk."""

    model_config = ConfigDict(extra="ignore")

    stage: str
    version: int
    fingerprint: str
    params: dict[str, Any]
    inputs: dict[str, str]
    sources: dict[str, FileDigests | None]
    previous: str | None = None
    outputs: dict[PathInside, OutputFile]
    outputs_digest: str
    numbers: dict[str, Any]
    wall_s: float
    cpu_s: float
    peak_rss: int
    versions: dict[str, str]
    created: str


def load_manifest(folder: Path) -> Manifest | None:
    """The manifest of a stage's folder, None where there is none.

    Raises:
        ManifestDamaged: there is one, but not a whole one.
        WorkspaceError: it is a link or no file.
    """
    try:
        text = read_own(folder / MANIFEST)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise ManifestDamaged(str(error)) from error
    return Manifest.from_json(text)


def output_problem(folder: Path, manifest: Manifest, most: int | None = CHEAP_BYTES) -> str | None:
    """The first output that is missing or not as published, in words; None where all are there.

    Args:
        folder: the published folder.
        manifest: its manifest.
        most: bytes that are read back and hashed, of the smallest files first; None: all. The others' sizes count.
    """
    left = most
    for path, expected in sorted(manifest.outputs.items(), key=lambda output: output[1].size):
        if left is not None:
            left -= expected.size
        if problem := _file_problem(folder / path, expected, left is None or left >= 0):
            return f"output {path} {problem}"
    return None


def _file_problem(file: Path, expected: OutputFile, hashes: bool) -> str | None:
    try:
        found = file.stat()
        if not stat.S_ISREG(found.st_mode):
            return "missing"
        if found.st_size != expected.size:
            return f"damaged ({found.st_size} bytes, published with {expected.size})"
        if hashes and file_sha256(file) != expected.sha256:
            return "damaged (contents changed)"
    except (FileNotFoundError, NotADirectoryError):  # also of a folder that another process replaces this instant
        return "missing"
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    return None


def describe_outputs(folder: Path) -> dict[str, OutputFile]:
    """Size and hash of every file below `folder`, the manifest left out."""
    return {
        path.relative_to(folder).as_posix(): OutputFile(path.stat().st_size, file_sha256(path))
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path != folder / MANIFEST
    }


@lru_cache
def current_versions() -> dict[str, str]:
    """Versions worth knowing when two machines give two results."""
    packages = {package: installed_version(package) or "absent" for package in RECORDED_PACKAGES}
    return {"python": platform.python_version(), "platform": platform.platform(), **packages}


def now() -> str:
    """UTC, ISO 8601, to the second."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def jsonable(value: Any) -> Any:
    """`value` with numpy scalars, paths and tuples turned into JSON's types; NaN and infinity become None.

    A stage's numbers go through it, so a stray NaN cannot cost a finished result.
    """
    if isinstance(value, Mapping):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [jsonable(item) for item in value]
    if hasattr(value, "tolist"):
        return jsonable(value.tolist())
    if isinstance(value, float):
        return value if value - value == 0 else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    return str(value)
