"""A mesh against a known object, whose surface and cameras are known: the demo's and the synthetic sets' score.

The truth is a folder with `gt_mesh.ply` (z up) and `transforms.json`. Mesh and truth meet by the camera centres of the
mesh's COLMAP model: a similarity, no ICP.

- The known surface counts where some camera sees it (first hit of the rays through the pixels): hidden inner
  faces ask nothing of a method that works from photos.
- The predicted mesh counts inside the known object's box, grown by `BOX_MARGIN`, and above `GROUND_MARGIN`:
  the table it may contain is not judged.
- accuracy: mean distance from points sampled uniformly on the predicted surface to the known surface.
- completeness: mean distance from the seen known surface to those points.
- normals: mean angle between the seen known surface and the mesh at the nearest of those points, not oriented.

All distances are in percent of the known object's largest extent, angles in degrees.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stages.errors import InputError
from stages.evaluation.reading import read_cameras, read_mesh
from stages.evaluation.surfaces import Sampling, Surface, Target, draw_points, measure_points
from stages.evaluation.thinning import one_a_cube
from stages.geometry.cameras import PinholeCameras
from stages.geometry.similarity import Similarity, align_points
from stages.surface.triangle_mesh import raycaster

TRUTH_MESH = "gt_mesh.ply"
TRUTH_CAMERAS = "transforms.json"

BOX_MARGIN = 0.04  # of the extent: a bulge just outside the object's box is still the method's fault
FACE_MARGIN = 0.05  # of the extent: faces that lie inside this box are the ones that are sampled again
GROUND_MARGIN = 0.012  # of the extent above the lowest point: the seam of object and table is nobody's surface
SEEN_SPACING = 0.004  # of the extent: one point of the seen surface a voxel, so that near views do not outvote
SAMPLES = 400_000
SCORE_THRESHOLDS = (0.005, 0.01)  # of the extent


@dataclass(frozen=True)
class KnownScore:
    """Distances in percent of the known object's largest extent; F-scores in percent; angles in degrees.

    Attributes:
        accuracy, completeness: means.
        mean: of accuracy and completeness; the number to compare.
        accuracy_median, completeness_median: the same with medians.
        f_half_percent, f_one_percent: harmonic mean of the shares of points nearer than 0.5 % and 1 %.
        normals_deg: mean angle between the seen known surface and the mesh where it is nearest, 0 to 90: which side a
            normal points to is ignored.
    """

    accuracy: float
    completeness: float
    mean: float
    accuracy_median: float
    completeness_median: float
    f_half_percent: float
    f_one_percent: float
    normals_deg: float

    def as_dict(self) -> dict[str, float]:
        """Rounded to a thousandth, for JSON and tables."""
        return {name: round(value, 3) for name, value in asdict(self).items()}


@dataclass(frozen=True)
class KnownObject:
    """The true object and who looked at it.

    Attributes:
        vertices: [V, 3] in the truth's frame, z up.
        faces: [F, 3] int.
        cameras: in the truth's frame.
    """

    vertices: np.ndarray
    faces: np.ndarray
    cameras: PinholeCameras

    @property
    def surface(self) -> Surface:
        return Surface(self.vertices, self.faces)

    def counts(self, points: np.ndarray) -> np.ndarray:
        """Which of predicted points [P, 3] are judged, [P] bool: near the object's box, above what it stands on."""
        low, high, margin = self.vertices.min(0), self.vertices.max(0), BOX_MARGIN * self.surface.extent
        inside: np.ndarray = np.all((points > low - margin) & (points < high + margin), axis=1)
        return inside & (points[:, 2] > self.ground)

    @property
    def ground(self) -> float:
        """Height below which nothing is judged."""
        return float(self.vertices[:, 2].min() + GROUND_MARGIN * self.surface.extent)


def score_surface(vertices: np.ndarray, faces: np.ndarray, known: KnownObject, samples: int = SAMPLES) -> KnownScore:
    """Compare a predicted mesh (vertices [V, 3], faces [F, 3], in the truth's frame) with the known surface.

    Raises:
        ValueError: no predicted surface lies inside the known object's box.
    """
    extent = known.surface.extent
    predicted = _judged(vertices, faces, known, samples)
    seen = seen_surface(known)
    true = Surface(seen, normals=Target(known.surface).nearest(seen).normals)
    found = measure_points(predicted, true, predicted, known.surface, [part * extent for part in SCORE_THRESHOLDS])
    assert found.completeness_normals is not None
    return KnownScore(
        accuracy=100 * found.accuracy.mean / extent,
        completeness=100 * found.completeness.mean / extent,
        mean=100 * found.chamfer / extent,
        accuracy_median=100 * found.accuracy.median / extent,
        completeness_median=100 * found.completeness.median / extent,
        f_half_percent=found.f_scores[0].f_score,
        f_one_percent=found.f_scores[1].f_score,
        normals_deg=found.completeness_normals.mean_deg,
    )


def _judged(vertices: np.ndarray, faces: np.ndarray, known: KnownObject, samples: int) -> Surface:
    """Points on a predicted mesh that count, with their faces' normals; see `score_surface`."""
    predicted = _counted(vertices, faces, known, samples)
    if len(predicted.points) < samples // 4:
        # The object is a small part of the mesh: sample it as if it stood alone.
        low, high, margin = known.vertices.min(0), known.vertices.max(0), FACE_MARGIN * known.surface.extent
        near = np.all((vertices > low - margin) & (vertices < high + margin), 1)[faces].all(1)
        if near.any():
            predicted = _counted(vertices, faces[near], known, samples)
    if len(predicted.points) == 0:
        raise ValueError("no surface of the mesh lies inside the known object's box: is it in the same frame?")
    return predicted


def _counted(vertices: np.ndarray, faces: np.ndarray, known: KnownObject, samples: int) -> Surface:
    """Those of points on a mesh, uniform by area, that count."""
    drawn = draw_points(Surface(vertices, faces), Sampling(samples))
    assert drawn.normals is not None
    counts = known.counts(drawn.points)
    return Surface(drawn.points[counts], normals=drawn.normals[counts])


def seen_surface(known: KnownObject) -> np.ndarray:
    """Points [P, 3] of the known surface that are asked for: seen by at least one camera's pixel centre, above the
    ground; evenly thinned."""
    scene = raycaster(known.vertices, known.faces)
    points = []
    for i in range(len(known.cameras)):
        rays = pinhole_rays(known.cameras, i)
        distance = scene.cast_rays(rays)["t_hit"].numpy()
        hit = np.isfinite(distance)
        chosen = rays.numpy()[hit]
        points.append(chosen[:, :3] + distance[hit][:, None] * chosen[:, 3:])
    seen = one_a_cube(np.concatenate(points), SEEN_SPACING * known.surface.extent)
    return seen[seen[:, 2] > known.ground]


def pinhole_rays(cameras: PinholeCameras, index: int) -> Any:
    """Open3D's rays [H, W, 6] through the pixel centres of one camera."""
    import open3d as o3d

    cam_from_world = np.vstack([cameras.extrinsics[index], [0, 0, 0, 1]])
    return o3d.t.geometry.RaycastingScene.create_rays_pinhole(
        o3d.core.Tensor(cameras.intrinsics[index]), o3d.core.Tensor(cam_from_world), *cameras.sizes[index].tolist()
    )


# ---------------------------------------------------------------- files
def has_truth(folder: Path) -> bool:
    """Whether a folder holds a known object to score against."""
    return (folder / TRUTH_MESH).is_file() and (folder / TRUTH_CAMERAS).is_file()


def load_known_object(folder: Path) -> KnownObject:
    """The known object of a folder.

    Raises:
        InputError: there is none, or it cannot be read.
    """
    if not has_truth(folder):
        raise InputError(
            f"{folder} holds no known object ({TRUTH_MESH} and {TRUTH_CAMERAS}).",
            "Name the folder that `hineus demo` made, or one with these two files.",
        )
    return KnownObject(*read_mesh(folder / TRUTH_MESH), read_cameras(folder / TRUTH_CAMERAS).pinhole)


def file_stem(name: str) -> str:
    """Name of a file without folders and suffix."""
    return Path(name).stem


def score_mesh(
    mesh_path: Path, model: Path, truth: Path, known_stem: Callable[[str], str] = file_stem
) -> dict[str, float]:  # fmt: skip
    """Distances of a mesh (in the frame of the COLMAP model) to the known object, see `KnownScore`.

    Args:
        known_stem: name of a photo in the model -> that of the truth without its suffix. Photos may have been renamed
            on the way in (another suffix): the stem decides.

    Raises:
        InputError: a file cannot be read, or nothing is left to measure.
    """
    known = load_known_object(truth)
    world_from_model = truth_from_model(known, model, truth, known_stem)
    vertices, faces = read_mesh(mesh_path)
    try:
        score = score_surface(world_from_model.apply(vertices), faces, known)
    except ValueError as error:
        raise InputError(f"{mesh_path} cannot be scored: {error}.", f"Look at it, and at {truth}.") from error
    return score.as_dict()


def truth_from_model(
    known: KnownObject, model: Path, truth: Path, known_stem: Callable[[str], str] = file_stem
) -> Similarity:
    """The similarity by which the camera centres of a COLMAP model meet the known ones; see `score_mesh`.

    Raises:
        InputError: the model cannot be read, or fewer than three of its cameras are known.
    """
    cameras = read_cameras(model).pinhole
    true_centers = dict(zip(map(file_stem, known.cameras.names), known.cameras.centers, strict=True))
    centers = dict(zip(cameras.names, cameras.centers, strict=True))
    shared = [name for name in sorted(centers) if known_stem(name) in true_centers]
    if len(shared) < 3:
        raise InputError(
            f"Only {len(shared)} of {len(centers)} cameras of {model} have a known pose (need 3).",
            f"Check that {truth} belongs to these photos.",
        )
    return align_points(
        np.array([centers[name] for name in shared]), np.array([true_centers[known_stem(name)] for name in shared])
    )
