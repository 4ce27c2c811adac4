"""Print the distance of a mesh to a known object as JSON.

python -m benchmarks.score MESH TRUTH_FOLDER --model COLMAP_MODEL
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from stages.errors import HineusError
from stages.evaluation.protocols.known_object import score_mesh


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", type=Path, help="in the model's frame, e.g. WORKSPACE/export/model.ply")
    parser.add_argument("truth", type=Path, help="folder with gt_mesh.ply and transforms.json")
    parser.add_argument("--model", type=Path, required=True, help="e.g. WORKSPACE/sfm/model")
    arguments = parser.parse_args()
    try:
        print(json.dumps(score_mesh(arguments.mesh, arguments.model, arguments.truth)))
    except HineusError as error:
        print(f"{error.message}\n{error.hint}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
