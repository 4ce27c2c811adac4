"""Meshes and points to the bytes of other programs: GLB, USDZ, OBJ, PLY, STL, LAZ. No stage, no path."""
