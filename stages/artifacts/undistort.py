"""What undistort publishes: pinhole images, masks, and the scene in the region that was found before training."""

from stages.artifacts.artifact import in_folder
from stages.artifacts.pictures import Pictures, pictures_of
from stages.artifacts.scene import scene_of

PINHOLE_PHOTOS = pictures_of("undistort")
# Masks that were guessed and agree with each other. They say where the subject ends, not that nothing is beside it:
# training sees the whole photos.
SILHOUETTES = in_folder("undistort", ("silhouettes/*",), lambda folder: Pictures(folder, "silhouettes"), optional=True)
FIRST_SCENE = scene_of("undistort")
