"""Every file of a workspace: its name, where it lies in its stage's folder, how it is saved and loaded.

Nobody else spells a path. Each function takes the folder of the stage that owns the file.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stages.errors import WorkspaceError
from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.place import Place
from stages.geometry.plane import Plane
from stages.geometry.similarity import Similarity

# ---------------------------------------------------------------- ingest: images/, masks/, images.json
IMAGES = "images"
MASKS = "masks"
IMAGE_RECORDS = "images.json"


@dataclass(frozen=True)
class ImageRecord:
    """One photo that was taken in.

    Attributes:
        name: relative posix path under `images/`; the source's own path when the file could be kept as it is.
        source: path of the photo relative to the photo folder.
        width, height: upright size in pixels.
        focal_px: focal length prior in pixels, or None.
        camera: photos with the same value share one camera's intrinsics.
        blur: variance of the Laplacian of the grey image at <= 1 megapixel; low is blurred.
        has_mask: whether `masks/<name>.png` exists.
        sha256: hash of the source file.
        gps: latitude and longitude in degrees (WGS 84) and altitude in metres, where EXIF has all three.
    """

    name: str
    source: str
    width: int
    height: int
    focal_px: float | None
    camera: str
    blur: float
    has_mask: bool
    sha256: str
    gps: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class SkippedImage:
    """A file that was left out, and why, in words."""

    source: str
    reason: str


@dataclass(frozen=True)
class ImageSet:
    """All that ingest found: photos kept (sorted by name) and files left out."""

    images: tuple[ImageRecord, ...]
    skipped: tuple[SkippedImage, ...] = field(default=())


def image_path(folder: Path, name: str) -> Path:
    """A stage's image `name` (ingest: upright photo, undistort: pinhole image)."""
    return folder / IMAGES / name


def mask_path(folder: Path, name: str) -> Path:
    """The mask of image `name`: 8-bit PNG, 255 on the object, same size as the image. May not exist."""
    return folder / MASKS / f"{name}.png"


def load_image(folder: Path, name: str) -> np.ndarray:
    """A stage's image `name`: [H, W, 3] uint8 RGB.

    Raises:
        WorkspaceError: it cannot be read.
    """
    import cv2

    # the pixels are upright already, whatever their EXIF says
    pixels = cv2.imread(str(image_path(folder, name)), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise _unreadable("image", image_path(folder, name), folder)
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)


def load_mask(folder: Path, name: str) -> np.ndarray | None:
    """The mask of image `name`: [H, W] uint8, 255 on the object; None where it has none.

    Raises:
        WorkspaceError: it is there but cannot be read.
    """
    import cv2

    path = mask_path(folder, name)
    if not path.exists():
        return None
    mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if mask is None:
        raise _unreadable("mask", path, folder)
    return mask


def write_png(path: Path, pixels: np.ndarray, compression: int | None = None) -> None:
    """Write [H, W] or [H, W, 3] RGB uint8; `compression` 0..9, None: OpenCV's choice.

    A full disk raises OSError, which OpenCV's own writer of files would hide.
    """
    import cv2

    options = [] if compression is None else [cv2.IMWRITE_PNG_COMPRESSION, compression]
    data = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR) if pixels.ndim == 3 else pixels
    _, encoded = cv2.imencode(".png", data, options)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encoded.tobytes())


def _unreadable(what: str, path: Path, folder: Path) -> WorkspaceError:
    return WorkspaceError(
        f"The {what} {path} cannot be read.", f"Make it again: `hineus run PHOTOS --force {folder.name}`."
    )


def save_image_set(folder: Path, image_set: ImageSet) -> None:
    write_json(folder / IMAGE_RECORDS, asdict(image_set))


def load_image_set(folder: Path) -> ImageSet:
    data = read_json(folder / IMAGE_RECORDS)
    return ImageSet(
        tuple(ImageRecord(**record) for record in data["images"]),
        tuple(SkippedImage(**record) for record in data["skipped"]),
    )


# ---------------------------------------------------------------- sfm: model/, registration.json, known_poses.json
MODEL = "model"
REGISTRATION = "registration.json"
KNOWN_POSES = "known_poses.json"


def model_path(folder: Path) -> Path:
    """Folder with the COLMAP model (cameras.bin, images.bin, points3D.bin)."""
    return folder / MODEL


def save_registration(folder: Path, registration: dict[str, Any]) -> None:
    """{"registered": [names], "unregistered": [{"name", "reason"}], "mean_reprojection_error_px",
    "num_points", "mapper", "matcher", "kept": the attempt whose model this is, "ladder": [an attempt each, see
    `stages.posing.ladder.Step`]}"""
    write_json(folder / REGISTRATION, registration)


def load_registration(folder: Path) -> dict[str, Any]:
    return read_json(folder / REGISTRATION)


def save_known_poses(folder: Path, origin: str, region: dict[str, Any] | None) -> None:
    """Where poses that were given came from; the sphere {"center", "radius", "source"} they say the object is in."""
    write_json(folder / KNOWN_POSES, {"origin": origin, "region": region})


def load_known_poses(folder: Path) -> dict[str, Any] | None:
    """What `save_known_poses` wrote; None where the poses were found and not given."""
    path = folder / KNOWN_POSES
    return read_json(path) if path.exists() else None


# ---------------------------------------------------------------- undistort: images/, masks/, scene.json, points.npz,
# overview.svg
SCENE = "scene.json"
POINTS = "points.npz"
OVERVIEW = "overview.svg"


def overview_path(folder: Path) -> Path:
    """Drawing of cameras, sparse points and the region of interest."""
    return folder / OVERVIEW


def save_scene(folder: Path, scene: PosedScene) -> None:
    cameras, place, ground = scene.cameras, scene.place, scene.ground
    write_json(
        folder / SCENE,
        {
            "kind": scene.kind,
            "up": scene.up.tolist(),
            "world_from_scene": _plain_similarity(scene.world_from_scene),
            "place": place
            and {
                "world_from_model": _plain_similarity(place.world_from_model),
                "metric": place.metric,
                "scale_from": place.scale_from,
                "scale_error": place.scale_error,
                "origin": place.origin,
                "gps_residual": place.gps_residual,
            },
            "ground": ground
            and {
                "normal": ground.normal.tolist(),
                "offset": ground.offset,
                "rms": ground.rms,
                "share": ground.share,
            },
            "box": None if scene.box is None else scene.box.tolist(),
            "cameras": [
                {
                    "name": name,
                    "size": cameras.sizes[i].tolist(),
                    "intrinsics": cameras.intrinsics[i].tolist(),
                    "cam_from_scene": cameras.cam_from_scene[i].tolist(),
                }
                for i, name in enumerate(cameras.names)
            ],
        },
    )
    np.savez(
        folder / POINTS,
        points=scene.points.astype(np.float32),
        point_errors=scene.point_errors.astype(np.float32),
        observations=scene.observations.astype(np.int32),
    )


def load_scene(folder: Path) -> PosedScene:
    data = read_json(folder / SCENE)
    with np.load(folder / POINTS) as points:
        sparse = {key: points[key] for key in ("points", "point_errors", "observations")}
    records = data["cameras"]
    place, ground, box = (data.get(key) for key in ("place", "ground", "box"))  # folders of 0.1.0 have none
    return PosedScene(
        cameras=PinholeCameras(
            names=tuple(record["name"] for record in records),
            sizes=np.array([record["size"] for record in records], dtype=np.int64),
            intrinsics=np.array([record["intrinsics"] for record in records]),
            cam_from_scene=np.array([record["cam_from_scene"] for record in records]),
        ),
        world_from_scene=_similarity(data["world_from_scene"]),
        up=np.array(data["up"]),
        kind=data["kind"],
        place=place and Place(**{**place, "world_from_model": _similarity(place["world_from_model"])}),
        ground=ground and Plane(**{**ground, "normal": np.array(ground["normal"])}),
        box=None if box is None else np.array(box),
        **sparse,
    )


def _plain_similarity(similarity: Similarity) -> dict[str, Any]:
    return {
        "scale": similarity.scale,
        "rotation": similarity.rotation.tolist(),
        "translation": similarity.translation.tolist(),
    }


def _similarity(data: dict[str, Any]) -> Similarity:
    return Similarity(data["scale"], np.array(data["rotation"]), np.array(data["translation"]))


# ---------------------------------------------------------------- train: field.pt, metrics.jsonl, previews/
FIELD = "field.pt"
METRICS = "metrics.jsonl"
HELD_OUT = "held_out.json"
PREVIEWS = "previews"
CHECKPOINT = "checkpoint.pt"  # in the stage's scratch folder


def field_path(folder: Path) -> Path:
    """The trained field, see `stages.neural.trained_field.TrainedField`."""
    return folder / FIELD


def save_held_out(folder: Path, names: Sequence[str]) -> None:
    """Names of the photos that neither training nor texture use."""
    write_json(folder / HELD_OUT, list(names))


def load_held_out(folder: Path) -> tuple[str, ...]:
    """Names of the photos that `train.hold_out` keeps back from training and texture; none where it is off."""
    path = folder / HELD_OUT
    return tuple(read_json(path)) if path.exists() else ()


def metrics_path(folder: Path) -> Path:
    """JSON lines, one object a logged step."""
    return folder / METRICS


def previews_path(folder: Path) -> Path:
    """Folder of the renders made while training."""
    return folder / PREVIEWS


def preview_path(folder: Path, step: int) -> Path:
    """Photo, render and normals side by side at one step."""
    return folder / PREVIEWS / f"{step:07d}.png"


def checkpoint_path(scratch: Path) -> Path:
    return scratch / CHECKPOINT


# ---------------------------------------------------------------- extract, cleanup: mesh.ply; cleanup: full_mesh.ply
MESH = "mesh.ply"
FULL_MESH = "full_mesh.ply"


def save_mesh(folder: Path, vertices: np.ndarray, faces: np.ndarray, name: str = MESH) -> None:
    """Write mesh.ply (binary): vertices [V, 3] in the scene frame, faces [F, 3]."""
    import trimesh

    trimesh.Trimesh(vertices, faces, process=False).export(folder / name)


def load_mesh(folder: Path, name: str = MESH) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] float32 in the scene frame and faces [F, 3] int32."""
    import trimesh

    mesh = trimesh.load(folder / name, process=False)
    return np.asarray(mesh.vertices, dtype=np.float32), np.asarray(mesh.faces, dtype=np.int32)


# ---------------------------------------------------------------- atlas: atlas.npz
ATLAS = "atlas.npz"


@dataclass(frozen=True)
class AtlasMesh:
    """A mesh whose vertices are split along the seams of its UV charts.

    Attributes:
        vertices: [V, 3] float32, scene frame.
        normals: [V, 3] float32 unit normals, smooth across seams.
        uvs: [V, 2] float32 in [0, 1], origin at the BOTTOM-left of the texture (OBJ's convention).
        faces: [F, 3] int32.
        texture_size: side in pixels of the texture the charts were packed for.
    """

    vertices: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    faces: np.ndarray
    texture_size: int


def save_atlas(folder: Path, atlas: AtlasMesh) -> None:
    np.savez(folder / ATLAS, **asdict(atlas))


def load_atlas(folder: Path) -> AtlasMesh:
    with np.load(folder / ATLAS) as data:
        return AtlasMesh(data["vertices"], data["normals"], data["uvs"], data["faces"], int(data["texture_size"]))


# ------------------------------------------ bake: base_color.png, provenance.png, vertex_quality.npz, and as set:
# normal_map.png, occlusion.png
BASE_COLOR = "base_color.png"
PROVENANCE = "provenance.png"
NORMAL_MAP = "normal_map.png"
OCCLUSION = "occlusion.png"
QUALITY = "vertex_quality.npz"


@dataclass(frozen=True)
class VertexQuality:
    """How well each vertex of the atlas is known, see `stages.texture.vertex_quality`.

    Attributes:
        seen_by: [V] uint16 photos that see it.
        facing: [V] float32 cosine between the normal and the direction to the photo that sees it most squarely; 0
            where none does.
        ambiguity: [V] float32 the paper's lambda: how far the photos disagree on its colour.
        photo_density: [V] float32 pixels per scene unit of the photo that shows it largest; 0 where none does.
        texel_density: [V] float32 texels per scene unit.
        invented: [V] float32 part of the texels around it that no photo saw.
    """

    seen_by: np.ndarray
    facing: np.ndarray
    ambiguity: np.ndarray
    photo_density: np.ndarray
    texel_density: np.ndarray
    invented: np.ndarray


def save_quality(folder: Path, quality: VertexQuality) -> None:
    np.savez(folder / QUALITY, **asdict(quality))


def load_quality(folder: Path) -> VertexQuality:
    with np.load(folder / QUALITY) as data:
        return VertexQuality(**data)


def base_color_path(folder: Path) -> Path:
    """8-bit sRGB texture; row 0 is v = 1."""
    return folder / BASE_COLOR


def provenance_path(folder: Path) -> Path:
    """8-bit grey, one value a texel, see `stages.texture.baking.Provenance`."""
    return folder / PROVENANCE


def normal_map_path(folder: Path) -> Path:
    """8-bit tangent-space normals, +Y up, see `stages.texture.relief.bake_normals`. May not exist."""
    return folder / NORMAL_MAP


def occlusion_path(folder: Path) -> Path:
    """8-bit grey, 255 where all is open, see `stages.texture.relief.bake_occlusion`. May not exist."""
    return folder / OCCLUSION


# ------------------------------------------------------------ export: model.glb, .usdz, .obj, .mtl, .ply, .stl, .png,
# and as set: model_lod1.glb, ..., model_collision.glb
def glb_path(folder: Path) -> Path:
    return folder / "model.glb"


def lod_path(folder: Path, level: int) -> Path:
    """The GLB of a level of detail, 1 or more; `glb_path` is level 0."""
    return folder / f"model_lod{level}.glb"


def collision_path(folder: Path) -> Path:
    """The GLB of convex pieces."""
    return folder / "model_collision.glb"


def obj_path(folder: Path) -> Path:
    return folder / "model.obj"


def mtl_path(folder: Path) -> Path:
    """The OBJ's material; it names the texture at `obj_texture_path`."""
    return folder / "model.mtl"


def obj_texture_path(folder: Path) -> Path:
    return folder / "model.png"


def obj_normal_map_path(folder: Path) -> Path:
    """The normal map that the MTL names, where there is one."""
    return folder / "model_normal.png"


def ply_path(folder: Path) -> Path:
    return folder / "model.ply"


def usdz_path(folder: Path) -> Path:
    return folder / "model.usdz"


def stl_path(folder: Path) -> Path:
    return folder / "model.stl"


# ---------------------------------------------------------------- report: report.html
def report_path(folder: Path) -> Path:
    return folder / "report.html"


# ---------------------------------------------------------------- JSON
def write_json(path: Path, data: Any) -> None:
    path.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))
