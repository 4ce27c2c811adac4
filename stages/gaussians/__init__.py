"""Gaussians on the surface: placing them, their colours, drawing them and what refines them."""
