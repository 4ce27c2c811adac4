"""Dense stereo: what neighbouring photos say of depth, and how far that is to be trusted. Knows no stage, no path."""
