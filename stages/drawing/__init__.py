"""Pictures: meshes to pixels, how these meet photos, and the capture from above. Arrays in, arrays out."""
