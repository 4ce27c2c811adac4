"""The neural surface: encodings, fields, sampling, rendering, losses, training. No stage, no path."""
