"""The shape: from a field to triangles, and what is done to triangles. Arrays and callables; no stage, no path."""
