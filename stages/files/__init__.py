"""Meshes, points and lights to the bytes of other programs: GLB, USDZ, OBJ, PLY, STL, LAZ, EXR, HDR. No stage."""
