"""JSON as it lies in a workspace: plain values, and records whose schema is a pydantic model."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    PlainSerializer,
    TypeAdapter,
    ValidationError,
)

from stages.artifacts.artifact import Artifact
from stages.artifacts.own_files import read_own, stays_inside
from stages.errors import WorkspaceError
from stages.inputs.texts import parse_json


def _numbers(value: Any) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind not in "biuf" or not np.isfinite(array).all():
        raise ValueError("expected finite numbers")
    return array


def _path_inside(name: str) -> str:
    if not stays_inside(name):
        raise ValueError(f"{name!r} leads out of its folder")
    return name


# A file's path relative to a folder of ours.
PathInside = Annotated[str, AfterValidator(_path_inside)]

if TYPE_CHECKING:
    Array = np.ndarray
else:
    # Nested lists of numbers in the file.
    Array = Annotated[np.ndarray, BeforeValidator(_numbers), PlainSerializer(lambda array: array.tolist())]


class Record(BaseModel):
    """What a JSON file holds. Made from any object with attributes of these names."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", from_attributes=True, arbitrary_types_allowed=True, allow_inf_nan=False
    )


Schema = TypeVar("Schema")
RecordSchema = TypeVar("RecordSchema", bound=Record)


def write_record(path: Path, record: Record) -> None:
    path.write_text(record.model_dump_json(indent=1) + "\n", encoding="utf-8")


def read_record(path: Path, schema: type[Schema]) -> Schema:
    """The record in a file: a `Record`, or another type that pydantic can check.

    Raises:
        WorkspaceError: there is no such file (an older version may have made the workspace), or it is not what the
            schema says.
    """
    try:
        return TypeAdapter(schema).validate_json(read_own(path))
    except OSError as error:
        raise WorkspaceError(
            f"{path} cannot be read: {error.strerror}.",
            f"Bring the workspace up to date: `hineus run --workspace {path.parent.parent}`.",
        ) from error
    except ValidationError as error:
        raise WorkspaceError(
            f"{path} cannot be read: {first_problem(error)}.",
            f"Make it again: `hineus run PHOTOS --force {path.parent.name}`.",
        ) from error


def first_problem(error: ValidationError) -> str:
    """What pydantic found first, and where: "Field required (outputs)"."""
    found = error.errors(include_url=False, include_input=False)[0]
    where = ".".join(str(part) for part in found["loc"]) or "the whole file"
    return f"{found['msg']} ({where})"


def record_artifact(stage: str, file: str, schema: type[RecordSchema]) -> Artifact[RecordSchema]:
    """A record as a JSON file."""
    return Artifact(
        stage,
        (file,),
        lambda folder: read_record(folder / file, schema),
        lambda folder, record: write_record(folder / file, record),
    )


def write_json(path: Path, data: Any) -> None:
    path.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    """What `write_json` wrote.

    Raises:
        OSError: it is not there, or cannot be read.
        ValueError: it is no JSON.
    """
    return parse_json(path.read_text(encoding="utf-8"))
