"""The pipeline from photos to a textured mesh, usable without the command line. `pipeline.py` is its contents page."""
