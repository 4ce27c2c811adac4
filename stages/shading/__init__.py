"""What the surface is made of, and the light on it, from many photos of each point. Arrays only."""
