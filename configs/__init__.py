"""Typed settings (`params`), the presets beside them, and how the two become one `Config` (`load`)."""
