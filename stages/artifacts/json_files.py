"""JSON as it lies in a workspace: plain values, and records whose schema is a pydantic model."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, PlainSerializer, ValidationError

from stages.artifacts.artifact import Artifact
from stages.errors import WorkspaceError

if TYPE_CHECKING:
    Array = np.ndarray
else:
    # Nested lists of numbers in the file.
    Array = Annotated[np.ndarray, BeforeValidator(np.asarray), PlainSerializer(lambda array: array.tolist())]


class Record(BaseModel):
    """What a JSON file holds. Made from any object with attributes of these names."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", from_attributes=True, arbitrary_types_allowed=True, allow_inf_nan=False
    )


Schema = TypeVar("Schema", bound=Record)


def write_record(path: Path, record: Record) -> None:
    path.write_text(record.model_dump_json(indent=1) + "\n", encoding="utf-8")


def read_record(path: Path, schema: type[Schema]) -> Schema:
    """The record in a file.

    Raises:
        WorkspaceError: there is no such file (an older version may have made the workspace), or it is not what the
            schema says.
    """
    try:
        return schema.model_validate_json(path.read_bytes())
    except OSError as error:
        raise WorkspaceError(
            f"{path} cannot be read: {error.strerror}.",
            f"Bring the workspace up to date: `hineus run --workspace {path.parent.parent}`.",
        ) from error
    except ValidationError as error:
        found = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in found["loc"]) or "the whole file"
        raise WorkspaceError(
            f"{path} cannot be read: {found['msg']} ({where}).",
            f"Make it again: `hineus run PHOTOS --force {path.parent.name}`.",
        ) from error


def record_artifact(stage: str, file: str, schema: type[Schema]) -> Artifact[Schema]:
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
    return json.loads(path.read_text(encoding="utf-8"))
