"""The neural surface: encodings, fields, sampling, rendering, losses, training. Torch and numba only; no stage, no path."""
