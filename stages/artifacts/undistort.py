"""What undistort publishes: pinhole images and masks, and the scene in the region that was found before training."""

from stages.artifacts.pictures import pictures_of
from stages.artifacts.scene import scene_of

PINHOLE_PHOTOS = pictures_of("undistort")
FIRST_SCENE = scene_of("undistort")
