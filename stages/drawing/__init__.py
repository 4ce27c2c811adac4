"""Meshes to pixels: rasteriser, pictures, and how they meet photos. Arrays in, arrays out."""
