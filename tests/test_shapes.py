"""`--check-shapes`: a wrong shape fails, and no annotation of what is checked goes unread."""

from __future__ import annotations

import importlib
import inspect
import typing

import numpy as np
import pytest
import torch
from shape_checks import checked_modules

from stages.geometry.cameras import PinholeCameras
from stages.geometry.plane import Plane, fit_plane
from stages.geometry.region import meeting_point
from stages.geometry.similarity import Similarity
from stages.neural.rendering import composite
from stages.neural.sampling import invert_cdf


@pytest.fixture(autouse=True)
def checked(request: pytest.FixtureRequest) -> None:
    if not request.config.getoption("--check-shapes"):
        pytest.skip("shapes are checked with --check-shapes")


def cameras(count: int) -> dict:
    return {
        "names": ("a.png",) * count,
        "sizes": np.full((count, 2), 8),
        "intrinsics": np.tile(np.eye(3), (count, 1, 1)),
        "extrinsics": np.tile(np.eye(3, 4), (count, 1, 1)),
    }


@pytest.mark.parametrize(
    "call",
    [
        lambda: Similarity.identity().apply(np.zeros((5, 2))),
        lambda: Similarity(1.0, np.eye(3), np.zeros(2)),
        lambda: PinholeCameras(**cameras(2)).project(0, np.zeros(3)),
        lambda: PinholeCameras(**cameras(2)).project(0, np.zeros((4, 3), int)),
        lambda: PinholeCameras(**{**cameras(2), "sizes": np.full((3, 2), 8)}),
        lambda: meeting_point(np.zeros((4, 3)), np.ones((5, 3))),
        lambda: fit_plane(np.zeros((4, 3)), np.array([0.0, 0, 1]), np.ones(5)),
        lambda: Plane(np.array([0.0, 0, 1, 0]), 0.0, 0.0, 1.0),
        lambda: composite(torch.zeros(4, 5), torch.zeros(4, 6, 3)),
        lambda: invert_cdf(torch.zeros(4, 6), torch.zeros(4, 6), torch.zeros(4, 3)),
    ],
)
def test_a_wrong_shape_fails(call):
    with pytest.raises(TypeError, match="Type-check error"):
        call()


def test_a_wrong_shape_that_comes_back_fails(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(np, "stack", lambda columns, axis: columns[0])
    with pytest.raises(TypeError, match="return value"):
        PinholeCameras(**cameras(1)).project(0, np.ones((4, 3)))


def annotated() -> list:
    """All functions, methods and records that are checked."""
    found = []
    for name in checked_modules():
        module = importlib.import_module(name)
        members = [one for one in vars(module).values() if getattr(one, "__module__", None) == name]
        for member in members:
            if isinstance(member, typing.TypeVar) or not callable(member):  # a name for a type, or a value
                continue
            found.append(member)
            if inspect.isclass(member):
                found += [f for f in vars(member).values() if inspect.isfunction(f)]
                found += [f.fget for f in vars(member).values() if isinstance(f, property)]
    return found


def test_every_annotation_can_be_read():
    """One that cannot be is passed over in silence."""
    assert len(annotated()) > 200
    for member in annotated():
        typing.get_type_hints(member)
