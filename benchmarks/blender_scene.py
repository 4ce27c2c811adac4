"""Runs inside Blender: import a model into an empty scene, say what came in, render a still.

blender --background --factory-startup --python benchmarks/blender_scene.py -- MODEL STILL.png
Prints one line, MARK and a JSON object. `benchmarks.blender_import` starts it.
"""

from __future__ import annotations

import json
import os
import sys
import time

import bpy  # Blender's own Python has it, no other
import numpy
from mathutils import Vector

# Debian 12's Blender 3.4 comes with a numpy that no longer knows this name, which its glTF importer uses.
if "bool" not in numpy.__dict__:
    numpy.bool = bool

MARK = "IMPORTED "
SEPARATORS = ("SEPARATE_COLOR", "SEPRGB")  # nodes that take an image apart, of today and of before 3.3
SIDE = 640  # of the still, pixels
SAMPLES = 16


def describe() -> dict:
    """Meshes, their UV layers and materials, and which image drives which input of the Principled BSDF."""
    meshes = [item for item in bpy.data.objects if item.type == "MESH"]
    materials = [material for material in bpy.data.materials if material.use_nodes and material.users]
    images: dict[str, str] = {}
    for material in materials:
        for node in material.node_tree.nodes:
            if node.type == "BSDF_PRINCIPLED":
                images |= {socket.name: found for socket in node.inputs if (found := behind(socket))}
            # Blender's shading has no occlusion; its importer keeps the map in a group of this name.
            if node.type == "GROUP" and "Occlusion" in node.inputs and (found := behind(node.inputs["Occlusion"])):
                images["Occlusion"] = found
    return {
        "blender": bpy.app.version_string,
        "meshes": len(meshes),
        "names": sorted(item.name for item in meshes),
        "triangles": sum(len(item.data.polygons) for item in meshes),
        "uv_layers": sum(len(item.data.uv_layers) for item in meshes),
        "materials": len(materials),
        "images": images,
        "size": [round(side, 4) for side in extent(meshes)[1]],
    }


def behind(socket) -> str | None:
    """Name, size and colour space of the image that feeds a socket, through whatever lies between, and the channel
    where it is one of them (Red, Green, Blue); None where there is no image."""
    for link in socket.links:
        node = link.from_node
        if node.type == "TEX_IMAGE" and node.image is not None and node.image.size[0] > 0:
            return f"{node.image.name} {node.image.size[0]}x{node.image.size[1]} {node.image.colorspace_settings.name}"
        channel = f" {link.from_socket.name}" if node.type in SEPARATORS else ""
        for inner in node.inputs:
            if found := behind(inner):
                return found + channel
    return None


def extent(meshes: list) -> tuple[Vector, Vector]:
    """Middle and sides of the box around the meshes, in Blender's world (z up)."""
    corners = [item.matrix_world @ Vector(corner) for item in meshes for corner in item.bound_box]
    low = Vector([min(corner[axis] for corner in corners) for axis in range(3)])
    high = Vector([max(corner[axis] for corner in corners) for axis in range(3)])
    return (low + high) / 2, high - low


def render(path: str) -> None:
    """A still by Cycles on the CPU: Eevee needs a GPU."""
    scene = bpy.context.scene
    middle, sides = extent([item for item in bpy.data.objects if item.type == "MESH"])
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.location = middle + Vector((0.8, -1.0, 0.45)).normalized() * 1.9 * max(sides)
    camera.rotation_euler = (middle - camera.location).to_track_quat("-Z", "Y").to_euler()
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy = 3.0
    sun.rotation_euler = (0.7, 0.2, 0.5)
    for item in (camera, sun):
        scene.collection.objects.link(item)
    scene.camera = camera
    scene.world = bpy.data.worlds.new("sky")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.6
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (1, 1, 1, 1)
    scene.view_settings.view_transform = "Standard"
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", SAMPLES, False
    scene.render.resolution_x = scene.render.resolution_y = SIDE
    scene.render.filepath = path
    bpy.ops.render.render(write_still=True)


def main(model: str, still: str) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    importers = {
        ".glb": bpy.ops.import_scene.gltf,
        ".usdz": bpy.ops.wm.usd_import,
        ".obj": bpy.ops.wm.obj_import,
        ".ply": bpy.ops.import_mesh.ply,
        ".stl": bpy.ops.import_mesh.stl,
    }
    started = time.perf_counter()
    try:
        importers[os.path.splitext(model)[1]](filepath=model)
    except AttributeError:  # Debian builds Blender without USD
        print(MARK + json.dumps({"blender": bpy.app.version_string, "no_importer": True}), flush=True)
        return
    seconds = round(time.perf_counter() - started, 2)
    print(MARK + json.dumps({**describe(), "import_s": seconds}), flush=True)
    if still:
        render(still)


if __name__ == "__main__":
    main(*sys.argv[sys.argv.index("--") + 1 :])
