"""What undistort publishes: pinhole images, masks, and the scene in the region that was found before training."""

from stages.artifacts.artifact import in_folder
from stages.artifacts.pictures import Pictures, pictures_of
from stages.artifacts.scene import scene_of

PINHOLE_PHOTOS = pictures_of("undistort")
# Masks that say where the object ends, not that nothing beside it counts: those of photos whose background stood still,
# and those that were guessed and agree with each other. Training sees the whole photos.
SILHOUETTES = in_folder("undistort", ("silhouettes/*",), lambda folder: Pictures(folder, "silhouettes"), optional=True)
FIRST_SCENE = scene_of("undistort")
