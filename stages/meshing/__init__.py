"""Meshes as arrays and fields as callables: isosurface, cleaning, atlas, baking. No stage, no path."""
