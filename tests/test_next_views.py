"""Where to stand next, on a ball that was photographed from one side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from rigs import scene_without_points

from stages.artifacts import VertexQuality
from stages.drawing.rendering import look_at
from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.plane import Plane
from stages.reporting.next_views import describe_place, suggest_views, vertex_needs

UP = np.array([0.0, 0, 1])
BALL = trimesh.creation.icosphere(3, 0.5)
VERTICES, FACES = np.asarray(BALL.vertices, np.float32), np.asarray(BALL.faces, np.int32)
NORMALS = VERTICES / 0.5


def place(azimuth: float, elevation: float, distance: float = 2.5) -> np.ndarray:
    a, e = np.radians([azimuth, elevation])
    return distance * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def scene_from(places: dict[str, np.ndarray], **more) -> PosedScene:
    views = [look_at(eye, np.zeros(3), UP, 40, 40) for eye in places.values()]
    cameras = PinholeCameras(
        tuple(places), *(np.concatenate([getattr(view, part) for view in views])
        for part in ("sizes", "intrinsics", "extrinsics")),
    )  # fmt: skip
    return scene_without_points(cameras, **more)


def seen_from(scene: PosedScene, vertices=VERTICES, normals=NORMALS) -> VertexQuality:
    """What photos of a convex thing see, in closed form."""
    cos = np.stack(
        [((c - vertices) * normals).sum(1) / np.linalg.norm(c - vertices, axis=1) for c in scene.cameras.centers]
    )
    seen = (cos > 0.17).sum(0)
    one = np.ones(len(vertices), np.float32)
    return VertexQuality(seen, cos.max(0) * (seen > 0), 0 * one, one, one, (seen == 0).astype(np.float32))


FRONT = {f"IMG_{i}.png": place(-30 + 10 * i, 10 if i % 2 else 25) for i in range(7)}
GROUND = Plane(UP, -0.5, 0.001, 0.9)


def test_the_need_of_a_vertex_is_its_worst_measure():
    quality = VertexQuality(
        np.array([0, 4, 9, 2, 9]), np.array([0, 0.9, 0.25, 0.9, 0.9]), *np.zeros((3, 5)), np.array([0, 0, 0, 0, 0.8])
    )
    np.testing.assert_allclose(vertex_needs(quality), [1, 0, 0.5, 0.5, 0.8])


def test_a_ball_seen_from_one_side_asks_for_the_other_side():
    scene = scene_from(FRONT, ground=GROUND)
    advice = suggest_views(VERTICES, NORMALS, FACES, vertex_needs(seen_from(scene)), scene)
    assert 2 <= len(advice.views) <= 6
    assert advice.views[0].position[0] < -1  # photos have x > 0
    assert "side that no photo shows" in advice.views[0].sentence
    assert [v.gain for v in advice.views] == sorted((v.gain for v in advice.views), reverse=True)
    assert 0.3 < advice.weak < 0.7
    for view in advice.views:
        assert GROUND.heights(view.position[None])[0] > 0
        assert np.linalg.norm(view.position) == pytest.approx(2.5, abs=0.02)
        np.testing.assert_allclose(view.target, 0, atol=1e-6)
    apart = [
        np.degrees(np.arccos(a.position @ b.position / 2.5**2))
        for a in advice.views
        for b in advice.views
        if a is not b
    ]
    assert min(apart) > 20


def test_taking_the_photos_that_were_asked_for_leaves_little_to_ask_for():
    scene = scene_from(FRONT, ground=GROUND)
    before = suggest_views(VERTICES, NORMALS, FACES, vertex_needs(seen_from(scene)), scene)
    taken = {f"new_{i}_{k}.png": v.position + 0.02 * k for i, v in enumerate(before.views) for k in range(4)}
    scene = scene_from(FRONT | taken, ground=GROUND)
    after = suggest_views(VERTICES, NORMALS, FACES, vertex_needs(seen_from(scene)), scene)
    assert after.weak < 0.3 * before.weak


def test_what_no_place_above_the_ground_sees_is_said_to_be_hidden():
    scene = scene_from(FRONT, ground=GROUND)
    needs = (VERTICES[:, 2] < -0.4).astype(float)
    advice = suggest_views(VERTICES, NORMALS, FACES, needs, scene)
    assert advice.hidden > 0.3
    assert advice.shown + advice.hidden <= 1
    assert all(GROUND.heights(view.position[None])[0] > 0 for view in advice.views)


def test_what_lies_under_the_ground_needs_no_photo():
    middle = Plane(UP, 0.0, 0.001, 0.9)
    ring = {f"{i}.png": place(36 * (i % 10), (5, 40, 80)[i // 10]) for i in range(30)}
    scene = scene_from(ring, ground=middle)
    advice = suggest_views(VERTICES, NORMALS, FACES, (VERTICES[:, 2] < -0.1).astype(float), scene)
    assert (advice.views, advice.weak) == ((), 0)
    assert (
        suggest_views(VERTICES, NORMALS, FACES, (VERTICES[:, 2] < -0.1).astype(float), replace(scene, ground=None)).weak
        > 0.3
    )


def test_without_a_ground_nobody_is_sent_far_below_the_photos():
    scene = scene_from(FRONT)
    advice = suggest_views(VERTICES, NORMALS, FACES, vertex_needs(seen_from(scene)), scene)
    assert advice.views
    assert min(view.position[2] for view in advice.views) > -2.5 * np.sin(np.radians(11))


def test_a_well_seen_ball_asks_for_nothing():
    ring = {f"{i}.png": place(36 * (i % 10), (-60, -20, 20, 60)[i // 10]) for i in range(40)}
    scene = scene_from(ring | {"top.png": place(0, 89), "foot.png": place(0, -89)})
    quality = replace(seen_from(scene), invented=np.zeros(len(VERTICES)))
    advice = suggest_views(VERTICES, NORMALS, FACES, vertex_needs(quality), scene)
    assert advice.views == ()
    assert advice.weak == 0


def test_a_wall_in_the_way_is_walked_around():
    wall = trimesh.creation.box((0.05, 3.2, 3.2), trimesh.transformations.translation_matrix([-1.5, 0, 0]))
    vertices = np.concatenate([VERTICES, wall.vertices]).astype(np.float32)
    normals = np.concatenate([NORMALS, wall.vertex_normals])
    faces = np.concatenate([FACES, wall.faces + len(VERTICES)])
    needs = np.concatenate([VERTICES[:, 0] < -0.45, np.zeros(8)]).astype(float)
    scene = scene_from({name: 2 * eye for name, eye in FRONT.items()}, ground=GROUND)
    straight = np.array([-5.0, 0, 0])
    for view in suggest_views(vertices, normals, faces, needs, scene).views:
        towards = view.position - view.target
        assert towards @ straight / np.linalg.norm(towards) / 5 < 0.95


def test_a_room_is_photographed_from_inside_it():
    room = trimesh.creation.box((2, 2, 2))
    room.invert()  # normals point inward
    for _ in range(3):
        room = room.subdivide()
    vertices, faces = np.asarray(room.vertices, np.float32), np.asarray(room.faces, np.int32)
    needs = (vertices[:, 0] < -0.99).astype(float)
    inside = {f"{i}.png": np.array([-0.4, 0.1 * i, 0.05 * i]) for i in range(3)}
    advice = suggest_views(vertices, np.asarray(room.vertex_normals), faces, needs, scene_from(inside, kind="forward"))
    assert advice.views
    assert all(np.abs(view.position).max() < 1 and view.target[0] < -0.9 for view in advice.views)


@pytest.mark.parametrize(
    ("azimuth", "elevation", "expected"),
    [
        (5, 55, ("Between b and c", "40 degrees higher", "times as high as its top", "down by about 55 degrees")),
        (0, -15, ("Between", "30 degrees lower", "near the height of its foot", "up by about 15 degrees")),
        (20, 14, ("From the direction of c", "same height", "height of its top")),
        (50, 14, ("30 degrees around to the right of c",)),
        (-60, 14, ("30 degrees around to the left of a",)),
        (170, 14, ("side that no photo shows, 150 degrees around to the right of c",)),
    ],
)
def test_sentences_lead_to_the_place(azimuth, elevation, expected):
    scene = scene_from({"a.png": place(-30, 15), "b.png": place(-10, 15), "c.png": place(20, 15)})
    sentence = describe_place(place(azimuth, elevation), np.zeros(3), scene, (-0.6, 0.6))
    for part in expected:
        assert part in sentence, sentence


def test_a_place_straight_above_has_words_too():
    scene = scene_from({"a.png": place(-30, 15), "b.png": place(60, 15)})
    assert "degrees higher" in describe_place(np.array([0, 0, 3.0]), np.zeros(3), scene)
