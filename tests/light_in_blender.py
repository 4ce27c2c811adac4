"""Runs inside Blender: what comes from some directions of an environment map behind an imported GLB's world.

blender --background --factory-startup --python tests/light_in_blender.py -- MAP.exr FOLDER
Prints one line, MARK and the mean colours [D, 3] seen towards `TOWARDS`.
"""

from __future__ import annotations

import json
import sys

MARK = "LIGHT "
TOWARDS = [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.0, -0.8), (0.36, 0.8, 0.48), (-0.8, -0.36, 0.48)]  # of the GLB


def main(light: str, folder: str) -> None:
    import bpy  # Blender's own Python has it, no other
    import numpy as np
    from mathutils import Vector

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene, data = bpy.context.scene, bpy.data
    scene.world = data.worlds.new("world")
    scene.world.use_nodes = True
    tree = scene.world.node_tree
    surroundings = tree.nodes.new("ShaderNodeTexEnvironment")
    surroundings.image = data.images.load(light)
    tree.links.new(surroundings.outputs["Color"], tree.nodes["Background"].inputs["Color"])
    scene.camera = data.objects.new("camera", data.cameras.new("camera"))
    scene.collection.objects.link(scene.camera)
    scene.camera.data.angle = 0.05
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", 4, False
    scene.render.resolution_x = scene.render.resolution_y = 4
    scene.render.image_settings.file_format = "OPEN_EXR"
    seen = []
    for k, (x, y, z) in enumerate(TOWARDS):
        there = Vector((x, -z, y))  # Blender's world has Z up; its importer of GLB turns so
        scene.camera.rotation_euler = there.to_track_quat("-Z", "Y").to_euler()
        scene.render.filepath = f"{folder}/{k}.exr"
        bpy.ops.render.render(write_still=True)
        pixels = np.array(data.images.load(scene.render.filepath).pixels[:]).reshape(-1, 4)
        seen.append(pixels[:, :3].mean(0).tolist())
    print(MARK + json.dumps(seen), flush=True)


if __name__ == "__main__":
    main(*sys.argv[sys.argv.index("--") + 1 :])
