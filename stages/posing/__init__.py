"""Where the camera poses come from."""
