"""Whether Blender takes our files as they are: import, check, and a still to look at.

python -m benchmarks.blender_import MODEL.glb [MODEL.usdz MODEL.obj ...] [--stills FOLDER]

Needs Blender; tried with 3.4 (Debian: apt-get install blender python3-numpy). Prints one JSON line a file; exits 1
where a GLB comes in without its mesh, UVs or one of the textures it holds at the Principled BSDF, 2 where there is no
Blender. A file that this Blender has no importer for is said to have `no_importer`.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

SCENE = Path(__file__).with_name("blender_scene.py")
MARK = "IMPORTED "
# Words by which the file says that it holds a texture, and the inputs of Blender's shader that it has to reach; of one
# that holds several maps, with the channel.
INPUTS = {
    b'"baseColorTexture"': {"Base Color": ""},
    b'"normalTexture"': {"Normal": ""},
    b'"occlusionTexture"': {"Occlusion": ""},
    b'"metallicRoughnessTexture"': {"Roughness": " Green", "Metallic": " Blue"},
}


def import_model(blender: str, model: Path, still: Path | None, time_limit: float = 540.0) -> dict[str, Any]:
    """What `blender_scene.describe` says of a model.

    Raises:
        RuntimeError: Blender failed.
    """
    command = [
        blender, "--background", "--factory-startup", "--python-exit-code", "1", "--python", str(SCENE), "--",
        str(model.resolve()), str(still.resolve()) if still else "",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=time_limit, check=False)
    lines = [line for line in done.stdout.splitlines() if line.startswith(MARK)]
    if done.returncode != 0 or not lines:
        raise RuntimeError(f"Blender ended with code {done.returncode}:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return json.loads(lines[0].removeprefix(MARK))


def missing(model: Path, found: dict[str, Any]) -> list[str]:
    """What a GLB has and Blender does not."""
    data = model.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    head = data[20 : 20 + length]
    lacking = [] if found["meshes"] and found["triangles"] else ["mesh"]
    if b"TEXCOORD_0" in head and not found["uv_layers"]:
        lacking.append("UVs")
    wanted = {name: channel for word, inputs in INPUTS.items() if word in head for name, channel in inputs.items()}
    return lacking + [name for name, channel in wanted.items() if not _reached(found["images"].get(name), channel)]


def _reached(image: str | None, channel: str) -> bool:
    return image is not None and image.endswith(channel)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--stills", type=Path, help="folder for a rendering of each")
    asked = parser.parse_args(arguments)
    blender = shutil.which("blender")
    if blender is None:
        print("there is no blender here: apt-get install blender python3-numpy, or put it on the PATH", file=sys.stderr)
        return 2
    failed = False
    for model in asked.models:
        still = None
        if asked.stills:
            asked.stills.mkdir(parents=True, exist_ok=True)
            still = asked.stills / f"{model.resolve().parent.parent.name}_{model.name}.png"
        found = import_model(blender, model, still)
        if model.suffix == ".glb":
            found["missing"] = missing(model, found)
            failed |= bool(found["missing"])
        print(json.dumps({"path": str(model), **found}), flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
