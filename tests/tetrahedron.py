"""What exports are tested on: a tetrahedron that no rotation maps to its mirror image, in a world of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rigs import scene_without_points, shell

from configs.params import ExportParams
from stages import artifacts
from stages.artifacts import AtlasMesh, write_png
from stages.engine.stage import StageContext
from stages.export import EXPORT
from stages.geometry.cameras import PinholeCameras
from stages.geometry.place import Place
from stages.geometry.similarity import Similarity
from stages.geometry.up import y_up_rotation

# No rotation maps this tetrahedron with its four colours to its mirror image.
CORNERS = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * [0.5, 0.4, 0.3]
FACES = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])  # counter-clockwise from outside
COLORS = np.array([[220, 30, 30], [30, 200, 40], [40, 60, 210], [230, 220, 40]], np.uint8)


def rotation_about(axis: np.ndarray, angle: float) -> np.ndarray:
    axis = axis / np.linalg.norm(axis)
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


def tetrahedron() -> tuple[AtlasMesh, np.ndarray]:
    """A tetrahedron with flat normals, each face a quarter of a 32² texture in a colour of its own."""
    vertices = CORNERS[FACES].reshape(-1, 3)
    normals = np.cross(vertices[1::3] - vertices[::3], vertices[2::3] - vertices[::3])
    assert ((normals * vertices[::3]).sum(1) > 0).all()
    normals = np.repeat(normals / np.linalg.norm(normals, axis=1, keepdims=True), 3, axis=0)
    texture = np.zeros((32, 32, 3), np.uint8)
    uvs = []
    for k in range(4):
        row, column = divmod(k, 2)
        texture[row * 16 : row * 16 + 16, column * 16 : column * 16 + 16] = COLORS[k]
        corner = np.array([column * 0.5, 1 - (row + 1) * 0.5])  # bottom-left of the quarter, v up
        uvs.append(corner + 0.5 * np.array([[0.2, 0.2], [0.8, 0.2], [0.2, 0.8]]))
    atlas = AtlasMesh(
        vertices.astype(np.float32),
        normals.astype(np.float32),
        np.concatenate(uvs).astype(np.float32),
        np.arange(12, dtype=np.int32).reshape(4, 3),
        32,
    )
    return atlas, texture


WORLD = Similarity(2.5, rotation_about(np.array([1.0, 2, -1]), 0.8), np.array([10.0, -4, 3]))
UP = np.array([0.0, 0, 1])


def workspace(tmp_path: Path, params: ExportParams | None = None) -> StageContext:
    folders = {
        name: tmp_path / name
        for name in ("densify", "train", "place", "atlas", "bake", "materials", "splats", "out", "scratch")
    }
    for folder in folders.values():
        folder.mkdir()
    atlas, texture = tetrahedron()
    cameras = PinholeCameras(
        ("a.jpg",), np.array([[8, 8]]), np.eye(3)[None], np.concatenate([np.eye(3), np.zeros((3, 1))], 1)[None]
    )
    artifacts.SCENE.save(folders["train"], scene_without_points(cameras, WORLD))
    artifacts.WORLD_PLACE.save(folders["place"], Place(Similarity.identity()))
    artifacts.GIVEN_REGION.save(folders["place"], None)
    artifacts.POINT_CLOUD.save(folders["densify"], shell().moved(WORLD))
    artifacts.ATLAS_MESH.save(folders["atlas"], atlas)
    write_png(artifacts.BASE_COLOR.load(folders["bake"]), texture)
    write_png(artifacts.NORMAL_MAP.load(folders["bake"]), np.full((32, 32, 3), (128, 128, 255), np.uint8))
    write_png(artifacts.OCCLUSION.load(folders["bake"]), np.full((32, 32), 200, np.uint8))
    return StageContext(
        inputs={name: folders[name] for name in EXPORT.needs},
        sources={},
        out=folders["out"],
        scratch=folders["scratch"],
        params=params or ExportParams(formats=("glb", "usdz", "obj", "ply", "stl")),
    )


def color_of(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Texture colour at UVs [P, 2] with a bottom-left origin."""
    size = texture.shape[0]
    return texture[((1 - uv[:, 1]) * size).astype(int), (uv[:, 0] * size).astype(int)][:, :3]


def expect_marks(vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray, from_scene) -> None:
    """Each face must lie where the tetrahedron's face of its colour lies, wound the same way."""
    assert len(faces) == 4
    for face, color in zip(faces, colors, strict=True):
        mark = np.flatnonzero((np.abs(COLORS.astype(int) - color) < 12).all(1))
        assert len(mark) == 1
        expected = from_scene(CORNERS[FACES[mark[0]]])
        found = vertices[face]
        turns = [np.roll(found, k, axis=0) for k in range(3)]  # any first corner, never another winding
        assert min(np.abs(turn - expected).max() for turn in turns) < 1e-4


def to_gltf(points: np.ndarray) -> np.ndarray:
    return WORLD.apply(points) @ y_up_rotation(WORLD.rotation @ UP).T


def packed_image(address: str) -> np.ndarray:
    """[H, W, 3] RGB of a resolved path "package.usdz[file.png]"."""
    import zipfile

    import cv2

    package, _, name = address.rstrip("]").partition("[")
    data = zipfile.ZipFile(package).read(name)
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
