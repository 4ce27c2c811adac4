"""What splats publishes: Gaussians on the surface."""

from __future__ import annotations

from stages.artifacts.artifact import place_artifact

# The arrays of `stages.gaussians.gaussians.Gaussians` by their names, in the frame of the mesh.
SPLATS = place_artifact("splats", "gaussians.npz", optional=True)
