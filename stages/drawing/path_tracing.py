"""The pictures of `stages.drawing.relighting` by Mitsuba 3: with shadows, and light that goes from part to part."""

from __future__ import annotations

import glob
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from stages.artifacts import AtlasMesh
from stages.drawing.relighting import Material
from stages.errors import SystemRequirementError
from stages.geometry.cameras import PinholeCameras
from stages.light.environment import turned

FAST, EVERYWHERE = "llvm_ad_rgb", "scalar_rgb"
LIBRARY = "DRJIT_LIBLLVM_PATH"
LIBRARIES = ("/usr/lib/*/libLLVM*.so*", "/usr/lib64/libLLVM*.so*", "/opt/homebrew/opt/llvm/lib/libLLVM.dylib")
# An old libLLVM ends the process instead of raising, so each is tried in one of its own.
TRIAL = (
    "import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); "
    "s = mi.load_dict(mi.cornell_box()); mi.render(s, spp=1).numpy()"
)
MAX_BOUNCES = 4
# Random paths of a pixel.
PATHS = 100


def choose_variant() -> tuple[str, str]:
    """The fastest variant of Mitsuba that runs here, and why; sets the path of libLLVM for this process.

    Raises:
        SystemRequirementError: Mitsuba is not installed.
    """
    try:
        import mitsuba  # noqa: F401
    except ImportError as error:
        raise SystemRequirementError("Mitsuba is not installed.", "Try `pip install 'hineus[bench]'`.") from error
    given = os.environ.get(LIBRARY)
    found = sorted((path for pattern in LIBRARIES for path in glob.glob(pattern)), key=_version, reverse=True)
    for library in [given] if given else found:
        environment = {**os.environ, LIBRARY: library}
        done = subprocess.run([sys.executable, "-c", TRIAL], env=environment, capture_output=True, check=False)
        if done.returncode == 0:
            os.environ[LIBRARY] = library
            return FAST, f"with {library}"
    reason = f"none of {len(found)} files" if found else "no file"
    return (
        EVERYWHERE,
        f"three times slower than with LLVM: {reason} of libLLVM; 19 is known to do, {LIBRARY} names another",
    )


def _version(path: str) -> tuple[int, ...]:
    """The numbers in a library's name."""
    name = Path(path).name
    return tuple(int(number) for number in "".join(c if c.isdigit() else " " for c in name).split())


class PathTracer:
    """One textured mesh, seen under one light.

    Mitsuba's principled surface stands for the glTF material: base colour, roughness and metalness mean the same, its
    matte part is Disney's. The occlusion map is left out, for occlusion is traced.
    """

    def __init__(self, mesh: AtlasMesh, material: Material, radiance: np.ndarray, variant: str) -> None:
        """A mesh and a light [H, 2 H, 3] in one frame, Y up; `variant` is one of Mitsuba's, see `choose_variant`."""
        import mitsuba

        mitsuba.set_variant(variant)
        self._mi = mitsuba
        self._radiance = radiance
        self._shape = _shape(mitsuba, mesh, material)
        self._scenes: dict[float, Any] = {}

    def relit(self, camera: PinholeCameras, turn_deg: float = 0.0, paths: int = PATHS) -> tuple[np.ndarray, np.ndarray]:
        """As `stages.drawing.relighting.relit`: linear radiance [H, W, 3] times coverage, and coverage [H, W]."""
        mi = self._mi
        width, height = (int(side) for side in camera.sizes[0])
        world_from_cam = np.linalg.inv(np.vstack([camera.extrinsics[0], [0, 0, 0, 1]])) @ np.diag([-1.0, -1, 1, 1])
        focal = camera.intrinsics[0, 0, 0]
        distance = float(np.linalg.norm(camera.centers[0]))
        sensor = mi.load_dict(
            {
                "type": "perspective",
                "fov_axis": "x",
                "fov": float(2 * np.degrees(np.arctan(width / 2 / focal))),
                "near_clip": 1e-3 * max(distance, 1e-6),
                "far_clip": 1e3 * max(distance, 1e-6),
                "to_world": mi.ScalarTransform4f(world_from_cam),
                "sampler": {"type": "multijitter", "sample_count": paths},
                "film": {
                    "type": "hdrfilm",
                    "width": width,
                    "height": height,
                    "pixel_format": "rgba",
                    "component_format": "float32",
                    "rfilter": {"type": "box"},
                },
            }
        )
        tracer = mi.load_dict({"type": "path", "max_depth": MAX_BOUNCES + 1, "hide_emitters": True})
        image = np.array(mi.render(self._scene(turn_deg), sensor=sensor, integrator=tracer, spp=paths), np.float32)
        return np.maximum(image[..., :3], 0), np.clip(image[..., 3], 0, 1)

    def _scene(self, turn_deg: float) -> Any:
        """The last one is kept: in pictures from many sides the light mostly stays."""
        if turn_deg not in self._scenes:
            mi = self._mi
            light = turned(self._radiance, turn_deg) if turn_deg else self._radiance
            # Mitsuba's map begins at -Z, where ours is a quarter along.
            begun = np.roll(light, -len(light) // 2, axis=1)
            bitmap = mi.Bitmap(np.ascontiguousarray(begun, np.float32))
            envmap = {"type": "envmap", "bitmap": bitmap}
            self._scenes = {turn_deg: mi.load_dict({"type": "scene", "shape": self._shape, "light": envmap})}
        return self._scenes[turn_deg]


def _shape(mi: Any, mesh: AtlasMesh, material: Material) -> Any:
    surface = {
        "type": "principled",
        "base_color": _texture(mi, material.base_color, raw=False),
        "roughness": _texture(mi, material.orm[..., 1:2], raw=True),
        "metallic": _texture(mi, material.orm[..., 2:3], raw=True),
    }
    if material.normal is not None:
        surface = {"type": "normalmap", "normalmap": _texture(mi, material.normal, raw=True), "bsdf": surface}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": surface})
    shape = mi.Mesh(
        "model", len(mesh.vertices), len(mesh.faces), properties, has_vertex_normals=True, has_vertex_texcoords=True
    )
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = np.ascontiguousarray(mesh.vertices, np.float32).ravel()
    parameters["vertex_normals"] = np.ascontiguousarray(mesh.normals, np.float32).ravel()
    parameters["vertex_texcoords"] = np.ascontiguousarray(mesh.uvs, np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(mesh.faces, np.uint32).ravel()
    parameters.update()
    return shape


def _texture(mi: Any, image: np.ndarray, raw: bool) -> dict[str, Any]:
    bitmap = mi.Bitmap(np.ascontiguousarray(image[::-1]))  # Mitsuba's row 0 is at v = 0
    bitmap.set_srgb_gamma(not raw)
    return {"type": "bitmap", "bitmap": bitmap, "raw": raw, "wrap_mode": "clamp"}
