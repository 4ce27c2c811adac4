"""Normal and occlusion maps against surfaces whose answers are known, read back as a viewer would read them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages.artifacts import AtlasMesh
from stages.drawing.rasterizing import Texels, rasterize_atlas
from stages.texture.relief import FLAT, bake_normals, bake_occlusion, relief_texels, sky_seen, spread_samples
from stages.texture.tangents import to_tangent_space, vertex_tangents

SIZE = 64
QUAD = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
CORNERS = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])


def sheet(uvs: np.ndarray = CORNERS) -> AtlasMesh:
    """The unit square at z = 0 that faces +z, with the texture all over it."""
    vertices = np.concatenate([CORNERS, np.zeros((4, 1))], 1).astype(np.float32)
    return AtlasMesh(vertices, np.tile(np.float32([0, 0, 1]), (4, 1)), uvs.astype(np.float32), QUAD, SIZE)


def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.02 * np.sin(2 * np.pi * x) * np.cos(np.pi * y) + 0.01 * x


def height_normals(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    slope_x = 0.04 * np.pi * np.cos(2 * np.pi * x) * np.cos(np.pi * y) + 0.01
    slope_y = -0.02 * np.pi * np.sin(2 * np.pi * x) * np.sin(np.pi * y)
    normals = np.stack([-slope_x, -slope_y, np.ones_like(x)], 1)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def bumpy(cells: int = 150) -> tuple[np.ndarray, np.ndarray]:
    x, y = (a.ravel() for a in np.meshgrid(*2 * [np.linspace(-0.02, 1.02, cells + 1)]))
    i = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + cells + 2], 1), np.stack([i, i + cells + 2, i + cells + 1], 1)])
    return np.stack([x, y, height(x, y)], 1).astype(np.float32), faces.astype(np.int32)


def texels_of(atlas: AtlasMesh, size: int = SIZE) -> Texels:
    return rasterize_atlas(atlas.uvs, atlas.faces, size)


def shaded_normals(atlas: AtlasMesh, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions and normals [T, 3] that a glTF viewer makes of the map at the texels: x t + y b + z n."""
    rastered = texels_of(atlas, len(image))
    texels, face_ids, corner = rastered.index, rastered.face_ids, rastered.corner
    tangents = vertex_tangents(atlas)
    points, n, t = (
        np.einsum("tk,tkc->tc", corner, values[atlas.faces[face_ids]])
        for values in (atlas.vertices, atlas.normals, tangents)
    )
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    w, t = t[:, 3:], t[:, :3] / np.linalg.norm(t[:, :3], axis=1, keepdims=True)
    x, y, z = (image.reshape(-1, 3)[texels] / 127.5 - 1).T[..., None]
    shaded = x * t + y * w * np.cross(n, t) + z * n
    return points, shaded / np.linalg.norm(shaded, axis=1, keepdims=True)


def angles_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((a * b).sum(1), -1, 1)))


def test_maps_have_half_the_side_where_the_full_mesh_shows_no_more():
    atlas = sheet()
    large, small = texels_of(atlas, 2048), texels_of(atlas, 1024)
    assert relief_texels(atlas, large, edge=4.1 / 2048).size == 1024
    assert relief_texels(atlas, large, edge=3.9 / 2048) is large
    assert relief_texels(atlas, small, edge=1.0) is small


# u and v along x and y, turned by a quarter, and mirrored
@pytest.mark.parametrize(
    ("uvs", "tangent", "bitangent"),
    [
        (CORNERS, (1, 0, 0), (0, 1, 0)),
        (np.stack([CORNERS[:, 1], 1 - CORNERS[:, 0]], 1), (0, 1, 0), (-1, 0, 0)),
        (np.stack([1 - CORNERS[:, 0], CORNERS[:, 1]], 1), (-1, 0, 0), (0, 1, 0)),
    ],
)
def test_bumps_on_a_plane_come_back_however_the_chart_lies(uvs, tangent, bitangent):
    atlas = sheet(uvs)
    image, met = bake_normals(atlas, texels_of(atlas), *bumpy())
    assert met == 1.0
    points, shaded = shaded_normals(atlas, image)
    expected = height_normals(points[:, 0], points[:, 1])
    assert angles_deg(expected, np.array([[0.0, 0, 1]])).max() > 6  # the bumps are worth a map
    assert angles_deg(shaded, expected).max() < 0.6  # half a level is 0.3 degrees
    # the same from the pixels alone: red is along u, green along v upwards
    texels = texels_of(atlas).index
    red, green, _ = (image.reshape(-1, 3)[texels] / 127.5 - 1).T
    np.testing.assert_allclose(red, expected @ tangent, atol=0.01)
    np.testing.assert_allclose(green, expected @ bitangent, atol=0.01)


def test_a_plane_far_from_the_full_mesh_or_facing_away_from_it_stays_flat():
    vertices, faces = bumpy(20)
    for full in ((vertices + np.float32([0, 0, 3]), faces), (vertices, faces[:, ::-1])):
        image, met = bake_normals(sheet(), texels_of(sheet()), *full)
        assert met == 0.0
        assert (image == FLAT).all()


def icosahedron() -> AtlasMesh:
    """Twenty faces with smooth normals, each a chart of its own in a grid of 5 x 4."""
    import trimesh

    mesh = trimesh.creation.icosahedron()
    corners = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    vertices = corners[mesh.faces].reshape(-1, 3).astype(np.float32)
    cell = np.stack(np.divmod(np.arange(20), 4), 1)
    uvs = (cell[:, None] + np.array([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9]])) / [5, 4]
    faces = np.arange(60, dtype=np.int32).reshape(-1, 3)
    return AtlasMesh(vertices, vertices.copy(), uvs.reshape(-1, 2).astype(np.float32), faces, 128)


def test_a_sphere_decimated_to_an_icosahedron_shades_as_a_sphere():
    import trimesh

    sphere = trimesh.creation.icosphere(5, 1.0)
    atlas = icosahedron()
    # normals of the faces, not smooth ones: all roundness must come from the map
    flat = np.cross(atlas.vertices[1::3] - atlas.vertices[::3], atlas.vertices[2::3] - atlas.vertices[::3])
    flat = np.repeat(flat / np.linalg.norm(flat, axis=1, keepdims=True), 3, axis=0).astype(np.float32)
    for normals in (atlas.normals, flat):
        model = AtlasMesh(atlas.vertices, normals, atlas.uvs, atlas.faces, 128)
        image, met = bake_normals(model, texels_of(model, 128), sphere.vertices, sphere.faces.astype(np.int32))
        assert met == 1.0
        points, shaded = shaded_normals(model, image)
        if normals is flat:  # the ray goes straight up from the face and meets the sphere there
            up = flat.reshape(20, 3, 3)[texels_of(atlas, 128).face_ids, 0]
            along = (points * up).sum(1, keepdims=True)
            points = points + up * (np.sqrt(1 - (points**2).sum(1, keepdims=True) + along**2) - along)
        expected = points / np.linalg.norm(points, axis=1, keepdims=True)
        assert angles_deg(shaded, expected).max() < 2


def test_tangents_are_unit_at_right_angles_and_of_the_side_of_the_chart():
    atlas = icosahedron()
    tangents = vertex_tangents(atlas)
    np.testing.assert_allclose(np.linalg.norm(tangents[:, :3], axis=1), 1, atol=1e-6)
    np.testing.assert_allclose((tangents[:, :3] * atlas.normals).sum(1), 0, atol=1e-6)
    assert (tangents[:, 3] == 1).all()
    mirrored = vertex_tangents(replace(atlas, uvs=atlas.uvs * [-1, 1]))
    np.testing.assert_allclose(mirrored[:, :3], -tangents[:, :3], atol=1e-6)
    assert (mirrored[:, 3] == -1).all()
    nowhere = vertex_tangents(replace(atlas, uvs=np.zeros_like(atlas.uvs)))
    np.testing.assert_allclose(np.linalg.norm(nowhere[:, :3], axis=1), 1, atol=1e-6)
    np.testing.assert_allclose((nowhere[:, :3] * atlas.normals).sum(1), 0, atol=1e-6)


def test_a_skewed_frame_gives_the_direction_back():
    rng = np.random.default_rng(0)
    unit = [v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, 50, 3))]
    directions, normals = unit
    t = np.cross(normals, rng.normal(size=(50, 3)))
    t = t / np.linalg.norm(t, axis=1, keepdims=True) + 0.2 * normals  # as between vertices
    for w in (1.0, -1.0):
        solved = to_tangent_space(directions, normals, np.concatenate([t, np.full((50, 1), w)], 1))
        unit_t = t / np.linalg.norm(t, axis=1, keepdims=True)
        frame = np.stack([unit_t, w * np.cross(normals, unit_t), normals], 1)
        again = np.einsum("pi,pic->pc", solved, frame)
        again /= np.linalg.norm(again, axis=1, keepdims=True)
        np.testing.assert_allclose(again, directions, atol=1e-9)


# ---------------------------------------------------------------- occlusion
def floor_and_wall(rise: float = 1.0, length: float = 60.0) -> AtlasMesh:
    """A floor [0, 1] x [-1/2, 1/2] at z = 0 beside a long wall at x = 0, `rise` high, that faces it."""
    floor = np.array([[0, -0.5, 0], [1, -0.5, 0], [1, 0.5, 0], [0, 0.5, 0]])
    wall = np.array([[0, length, 0], [0, -length, 0], [0, -length, rise], [0, length, rise]])
    normals = np.repeat([[0.0, 0, 1], [1, 0, 0]], 4, axis=0)
    left = CORNERS * [0.48, 1]
    uvs = np.concatenate([left, left + np.array([0.52, 0])])
    return AtlasMesh(
        np.concatenate([floor, wall]).astype(np.float32),
        normals.astype(np.float32),
        uvs.astype(np.float32),
        np.concatenate([QUAD, QUAD + 4]),
        SIZE,
    )


def beside_a_wall(distance: np.ndarray, rise: float = 1.0) -> np.ndarray:
    """Openness of a floor: 1 - (1 - cos a) / 2, a the angle under which the top of an endless wall is seen."""
    return 0.5 + 0.5 * distance / np.sqrt(distance**2 + rise**2)


def test_a_floor_beside_a_wall_sees_the_known_part_of_the_sky():
    atlas = floor_and_wall()
    x = np.linspace(0.05, 0.95, 40)
    points = np.stack([x, np.zeros(40), np.zeros(40)], 1)
    seen = sky_seen(atlas.vertices, atlas.faces, points, np.tile([0.0, 0, 1], (40, 1)), 1024, 1e4)
    np.testing.assert_allclose(seen, beside_a_wall(x), atol=0.02)
    # what lies beyond the reach hides nothing
    near = sky_seen(atlas.vertices, atlas.faces, points, np.tile([0.0, 0, 1], (40, 1)), 256, 0.3)
    assert (near[x > 0.31] == 1).all()
    assert (near[x < 0.2] < 1).all()


def test_the_map_of_a_floor_beside_a_wall_and_nothing_bleeds_between_charts():
    atlas = floor_and_wall()
    image = bake_occlusion(atlas, texels_of(atlas), rays=256, reach=1e4)
    row = image[SIZE // 2] / 255
    x = (np.arange(30) + 0.5) / (0.48 * SIZE)
    np.testing.assert_allclose(row[:30][2:-2], beside_a_wall(x)[2:-2], atol=0.04)
    # the wall's chart begins two texels on: it sees half of the sky and, from its far ends, all of it
    assert image[:, 34:].mean() / 255 > 0.97


def test_a_convex_body_is_open_everywhere():
    atlas = icosahedron()
    flat = np.cross(atlas.vertices[1::3] - atlas.vertices[::3], atlas.vertices[2::3] - atlas.vertices[::3])
    flat = np.repeat(flat / np.linalg.norm(flat, axis=1, keepdims=True), 3, axis=0).astype(np.float32)
    model = AtlasMesh(atlas.vertices, flat, atlas.uvs, atlas.faces, 64)
    assert (bake_occlusion(model, texels_of(model, 64), rays=32) == 255).all()


def test_samples_are_carried_between_squares_linearly_and_not_across_space():
    size = 16
    texels = np.arange(size * size)
    y, x = np.divmod(texels, size)
    points = np.stack([x, y, np.zeros(size * size)], 1).astype(float)
    cell = (np.arange(4) * 4 + 1)[:, None] * size + np.arange(4) * 4 + 1  # a sample in each square
    cell_of = np.arange(16).reshape(4, 4)
    values = points[cell.ravel(), 0]
    spread = spread_samples(values, points[cell.ravel()], cell_of, texels, points, size).reshape(size, size)
    np.testing.assert_allclose(spread[4:12, 4:12], x.reshape(size, size)[4:12, 4:12], atol=1.2)
    # the right half lies elsewhere in space
    points[x >= 8, 2] = 100.0
    values = np.where(points[cell.ravel(), 2] > 0, 1.0, 0.0)
    spread = spread_samples(values, points[cell.ravel()], cell_of, texels, points, size)
    np.testing.assert_allclose(spread, (x >= 8).astype(float), atol=1e-6)
