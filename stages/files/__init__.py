"""Meshes, points, splats, lights to the bytes of other programs: GLB, USDZ, OBJ, PLY, STL, SPZ, LAZ, HDR. No stage."""
