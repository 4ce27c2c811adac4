"""COLMAP's patch match without a GPU: the workspace as COLMAP itself reads it, and its files read back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rigs import capture, look_at, scene_without_points

from stages.artifacts import Pictures, write_png
from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.stereo import patch_match
from stages.stereo.patch_match import patch_match_depths, read_array, reduced_cameras, write_workspace

NORMAL, HEIGHT = np.array([0.3, 0.1, 1.0]) / np.linalg.norm([0.3, 0.1, 1.0]), 0.2


@pytest.fixture
def cameras() -> PinholeCameras:
    """Four photos of a slanted plane from above, the last narrower than the others; odd names."""
    found = capture([look_at(np.array([x, y, 4.0]), np.zeros(3)) for x, y in ((-1, -1), (1, -1), (1, 1.2), (-1, 1))])
    sizes, intrinsics = found.sizes // 4, found.intrinsics.copy()
    intrinsics[:, :2] /= 4
    sizes[3, 0] = 140
    names = ("a b.png", "#1.png", "folder/c,d.png", "ü.png")
    return PinholeCameras(names, sizes, intrinsics, found.extrinsics)


@pytest.fixture
def pictures(cameras: PinholeCameras, tmp_path: Path) -> Pictures:
    found = Pictures(tmp_path)
    for index, name in enumerate(cameras.names):
        width, height = cameras.sizes[index]
        write_png(found.path(name), np.full((height, width, 3), 50 + 40 * index, np.uint8))
    return found


def on_plane(count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Points of the plane, and that all four photos see all of them."""
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (count, 3))
    points[:, 2] = (HEIGHT - points[:, :2] @ NORMAL[:2]) / NORMAL[2]
    return points, np.array([(photo, point) for photo in range(4) for point in range(count)])


def posed(cameras: PinholeCameras, points: np.ndarray, observations: np.ndarray) -> PosedScene:
    sparse = {"points": points.astype(np.float32), "point_errors": np.zeros(len(points), np.float32)}
    return replace(scene_without_points(cameras), **sparse, observations=observations)


def plane_depths(cameras: PinholeCameras, index: int) -> np.ndarray:
    """Depth of the plane [h, w] at the pixels' centres."""
    width, height = cameras.sizes[index]
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    origins, rays = cameras.rays(index, np.stack([columns.ravel(), rows.ravel()], 1))
    along = (HEIGHT - origins @ NORMAL) / (rays @ NORMAL)
    depth = along * (rays @ cameras.forward[index])
    return depth.reshape(height, width).astype(np.float32)


def padded(array: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    width, height = size
    return np.pad(array, [(0, height - array.shape[0]), (0, width - array.shape[1]), *[(0, 0)] * (array.ndim - 2)])


def write_maps(folder: Path, cameras: PinholeCameras) -> None:
    """The plane, as COLMAP would have found it, of all photos but the second."""
    import pycolmap

    size = tuple(cameras.sizes.max(0).tolist())
    for index in (0, 2, 3):
        depth = padded(plane_depths(cameras, index), size)
        normal = np.where(depth[:, :, None] > 0, cameras.extrinsics[index, :, :3] @ NORMAL, 0).astype(np.float32)
        stereo, name = folder / "stereo", f"{index:06d}.png.geometric.bin"
        pycolmap.DepthMap.from_array(depth, 1, 10).write(stereo / "depth_maps" / name)
        pycolmap.NormalMap.from_array(normal).write(stereo / "normal_maps" / name)


def test_colmap_fuses_the_maps_to_the_plane(cameras: PinholeCameras, pictures: Pictures, tmp_path: Path) -> None:
    import pycolmap

    folder = tmp_path / "workspace"
    reduced = write_workspace(posed(cameras, *on_plane()), pictures, folder, max_side=120)
    write_maps(folder, reduced)
    (tmp_path / "fused").mkdir()
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels, options.num_threads = 2, 1
    fused = pycolmap.stereo_fusion(tmp_path / "fused", folder, options=options)
    found = np.array([point.xyz for point in fused.points3D.values()])
    assert len(found) > 1000
    # where COLMAP is given our principal points, it is 9e-3: half a pixel
    assert np.abs(found @ NORMAL - HEIGHT).max() < 1e-3


def test_colmap_reads_cameras_and_points(cameras: PinholeCameras, pictures: Pictures, tmp_path: Path) -> None:
    import pycolmap

    points, observations = on_plane()
    seen_by_one = np.concatenate([points, [[0.0, 0, 3]]])
    scene = posed(cameras, seen_by_one, np.append(observations, [[0, 60]], 0))
    write_workspace(scene, pictures, tmp_path / "out", 120)
    model = pycolmap.Reconstruction(str(tmp_path / "out" / "sparse"))
    assert {image.name for image in model.images.values()} == {f"{i:06d}.png" for i in range(4)}
    assert {(camera.model_name, camera.width, camera.height) for camera in model.cameras.values()} == {
        ("PINHOLE", 120, 103)  # 140 x 120 became 120 x 103, 160 x 120 became 120 x 90
    }
    assert model.num_points3D() == 60
    assert model.compute_mean_reprojection_error() < 1e-4
    points3d = np.array([model.points3D[k].xyz for k in sorted(model.points3D)])
    np.testing.assert_allclose(points3d, points, atol=1e-6)
    camera = model.cameras[model.images[1].camera_id]
    np.testing.assert_allclose(camera.params, [112.5, 112.5, 59.5, 44.5])
    picture = Pictures(tmp_path / "out").image("000000.png")
    assert (picture[:90] == 50).all()
    assert not picture[90:].any()


def test_photos_that_see_nothing_are_no_problems_to_solve(
    cameras: PinholeCameras, pictures: Pictures, tmp_path: Path
) -> None:
    points, observations = on_plane()
    scene = posed(cameras, points, observations[observations[:, 0] != 2])
    write_workspace(scene, pictures, tmp_path / "out", 120)
    problems = (tmp_path / "out" / "stereo" / "patch-match.cfg").read_text().splitlines()
    assert problems[::2] == ["000000.png", "000001.png", "000003.png"]
    assert set(problems[1::2]) == {"__auto__, 20"}


def test_depths_come_back_by_photo(
    cameras: PinholeCameras, pictures: Pictures, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import pycolmap

    folder, told, asked, scene = tmp_path / "out", [], [], posed(cameras, *on_plane())
    reduced = reduced_cameras(cameras, 120)

    def match(workspace: Path, options) -> None:
        asked.append(options)
        write_maps(workspace, reduced)

    monkeypatch.setattr(pycolmap, "patch_match_stereo", match)
    monkeypatch.setattr(patch_match, "POLL_S", 0.001)
    found = list(patch_match_depths(scene, pictures, folder, 120, lambda *done: told.append(done)))
    assert [index for index, _ in found] == [0, 2, 3]
    for index, depth in found:
        np.testing.assert_allclose(depth, plane_depths(reduced, index), rtol=1e-6)
    assert asked[0].allow_missing_files
    assert told[-1] == (3, 8, "matching")


@pytest.mark.skipif("__import__('pycolmap').has_cuda", reason="there is a GPU, or may be")
def test_without_cuda_colmap_says_so(cameras: PinholeCameras, pictures: Pictures, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="CUDA"):
        list(patch_match_depths(posed(cameras, *on_plane()), pictures, tmp_path / "out", 120, lambda *done: None))


def test_arrays_as_colmap_documents_them(tmp_path: Path) -> None:
    values = np.array([[1, 2, 3], [4, 5, np.nan]], "<f4")
    (tmp_path / "depth").write_bytes(b"3&2&1&" + values.tobytes())
    np.testing.assert_array_equal(read_array(tmp_path / "depth"), values)
    # its numbers may contain the sign that separates the header's
    ampersand = np.frombuffer(b"&&&&" * 2, "<f4")
    (tmp_path / "odd").write_bytes(b"2&1&1&" + ampersand.tobytes())
    np.testing.assert_array_equal(read_array(tmp_path / "odd")[0], ampersand)
    (tmp_path / "short").write_bytes(b"4&2&1&" + values.tobytes())
    with pytest.raises(ValueError, match="expected 4 x 2 numbers, got 6"):
        read_array(tmp_path / "short")
