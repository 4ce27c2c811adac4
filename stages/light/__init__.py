"""Light from all around: environment maps, spherical harmonics, and what surfaces make of them. Arrays only."""
