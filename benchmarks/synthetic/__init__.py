"""Photos of made-up objects whose surface and cameras are known: `python -m benchmarks.synthetic --help`."""

MADE_WITH = "made_with.json"  # in each scene's folder: what it was made with
