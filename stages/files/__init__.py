"""Meshes to the bytes of other programs: GLB, USDZ, OBJ, PLY, STL. No stage, no path."""
