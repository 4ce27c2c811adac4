"""Cameras, similarities and the normalised frame. Pure NumPy."""
