"""Textured meshes as USDZ, the package that Apple's Quick Look and most 3D programs open. Arrays in, bytes out."""

from __future__ import annotations

import io
import json
import struct
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from stages.artifacts import AtlasMesh
from stages.files.contents import ROUGHNESS, Textures, checked_mesh

ROOT = "/model"
ROOT_LAYER = "model.usdc"  # AR viewers want the binary form, and first in the package
# Where files may begin in a package, in bytes; and the id of the zip's field that USD fills up with.
ALIGNMENT, PADDING_FIELD = 64, 0x1986


def usdz_bytes(mesh: AtlasMesh, textures: Textures, extras: dict[str, Any] | None = None) -> bytes:
    """A USDZ package of one mesh with one UsdPreviewSurface, as ARKit asks for it.

    Args:
        mesh: in a right-handed, Y-up frame; metres, as in glTF.
        textures: of the material.
        extras: JSON-able, kept as text under "hineus" in the layer's own data.

    Raises:
        ImportError: there is no usd-core.
        ValueError: see `checked_mesh`.
    """
    mesh = checked_mesh(mesh)
    images = texture_files(textures)

    def fill(stage: Any) -> None:
        describe(stage, extras)
        add_material(stage, add_mesh(stage, mesh), set(images))

    return packed({ROOT_LAYER: layer_bytes(fill), **images})


def texture_files(textures: Textures) -> dict[str, bytes]:
    """The images of a package and their names in it."""
    images = {
        "base_color.png": textures.base_color,
        "orm.png": textures.orm,
        "normal.png": textures.normal,
        "occlusion.png": textures.occlusion,
    }
    return {name: png for name, png in images.items() if png is not None}


def layer_bytes(fill: Callable[[Any], None]) -> bytes:
    """The binary layer of a new stage that `fill` has filled. The library writes such to files only."""
    from pxr import Usd

    with tempfile.TemporaryDirectory(prefix="usdz-") as folder:
        layer = Path(folder) / ROOT_LAYER
        stage = Usd.Stage.CreateNew(str(layer))
        fill(stage)
        stage.GetRootLayer().Save()
        return layer.read_bytes()


def packed(files: dict[str, bytes]) -> bytes:
    """A USDZ of files in this order: a zip without compression whose files begin at multiples of 64 bytes.

    The library's own packer changed its name between versions, and renames the images.
    """
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_STORED) as package:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name)
            # The header takes 30 bytes and the name; an extra field (4 bytes and its content) fills up.
            fill = -(data.tell() + 30 + len(name) + 4) % ALIGNMENT
            entry.extra = struct.pack("<HH", PADDING_FIELD, fill) + bytes(fill)
            package.writestr(entry, content)
    return data.getvalue()


def describe(stage: Any, extras: dict[str, Any] | None) -> None:
    """Y up, metres, the root that others refer to, and `extras`."""
    from pxr import UsdGeom

    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, ROOT).GetPrim())
    if extras:
        stage.GetRootLayer().customLayerData = {"hineus": json.dumps(extras)}


def add_shape(stage: Any, path: str, vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray | None = None) -> Any:
    """A mesh of triangles [F, 3] of vertices [V, 3], flat where it has no `normals` [V, 3] float32."""
    from pxr import UsdGeom, Vt

    made = UsdGeom.Mesh.Define(stage, path)
    points = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(vertices, dtype=np.float32))
    made.CreatePointsAttr(points)
    made.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(points))
    made.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, dtype=np.int32)))
    made.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.astype(np.int32).ravel()))
    if normals is not None:
        made.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals))
        made.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    made.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    return made


def add_mesh(stage: Any, mesh: AtlasMesh) -> Any:
    """The textured mesh, checked, at `ROOT`/mesh."""
    from pxr import Sdf, UsdGeom, Vt

    made = add_shape(stage, f"{ROOT}/mesh", mesh.vertices, mesh.faces, mesh.normals)
    st = UsdGeom.PrimvarsAPI(made).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
    st.Set(Vt.Vec2fArray.FromNumpy(mesh.uvs))
    return made


def add_material(stage: Any, mesh: Any, files: set[str]) -> None:
    """A preview surface of the images `files`, see `texture_files`, bound to the mesh.

    Without a map of roughness and metalness it is no metal and of `ROUGHNESS`. Its model is glTF's: GGX, F0 of 0.04 by
    its default index of refraction.
    """
    from pxr import Gf, Sdf, UsdShade

    types = Sdf.ValueTypeNames
    material = UsdShade.Material.Define(stage, f"{ROOT}/material")

    def shader(child: str, kind: str) -> Any:
        made = UsdShade.Shader.Define(stage, material.GetPath().AppendChild(child))
        made.CreateIdAttr(kind)
        return made

    reader = shader("st", "UsdPrimvarReader_float2")
    reader.CreateInput("varname", types.String).Set("st")
    reader.CreateOutput("result", types.Float2)
    surface = shader("surface", "UsdPreviewSurface")
    if "orm.png" not in files:
        surface.CreateInput("roughness", types.Float).Set(ROUGHNESS)
        surface.CreateInput("metallic", types.Float).Set(0.0)

    def texture(file: str, space: str, **inputs: str) -> Any:
        """An image whose channels, "rgb" or one of them, go to inputs of the surface."""
        made = shader(Path(file).stem, "UsdUVTexture")
        made.CreateInput("file", types.Asset).Set(Sdf.AssetPath(file))
        made.CreateInput("sourceColorSpace", types.Token).Set(space)
        for wrap in ("wrapS", "wrapT"):
            made.CreateInput(wrap, types.Token).Set("clamp")
        made.CreateInput("st", types.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
        for output, into in inputs.items():
            made.CreateOutput(output, types.Float3 if output == "rgb" else types.Float)
            surface.CreateInput(into, kinds.get(into, types.Float)).ConnectToSource(made.ConnectableAPI(), output)
        return made

    kinds = {"diffuseColor": types.Color3f, "normal": types.Normal3f}
    texture("base_color.png", "sRGB", rgb="diffuseColor")
    if "orm.png" in files:
        texture("orm.png", "raw", r="occlusion", g="roughness", b="metallic")
    if "normal.png" in files:
        normal = texture("normal.png", "raw", rgb="normal")
        # from 0..1 to -1..1
        normal.CreateInput("scale", types.Float4).Set(Gf.Vec4f(2, 2, 2, 1))
        normal.CreateInput("bias", types.Float4).Set(Gf.Vec4f(-1, -1, -1, 0))
    if "occlusion.png" in files:
        texture("occlusion.png", "raw", r="occlusion")
    surface.CreateOutput("surface", types.Token)
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
