"""What undistort publishes: pinhole images, masks, and the scene in the region that was found before training."""

from stages.artifacts.artifact import in_folder
from stages.artifacts.pictures import Pictures, pictures_of
from stages.artifacts.scene import scene_of

PINHOLE_PHOTOS = pictures_of("undistort")
# Masks that say where the object ends, not that nothing beside it counts: training sees the whole photos. OUTLINES were
# given, of photos whose background shows in the model; SILHOUETTES were guessed and agree with each other.
OUTLINES = in_folder("undistort", ("outlines/*",), lambda folder: Pictures(folder, "outlines"), optional=True)
SILHOUETTES = in_folder("undistort", ("silhouettes/*",), lambda folder: Pictures(folder, "silhouettes"), optional=True)
FIRST_SCENE = scene_of("undistort")


def given_mask_of(name: str, photos: Pictures, outlines: Pictures) -> Pictures:
    """Of `PINHOLE_PHOTOS` and `OUTLINES` the one that has the mask of photo `name`, which both have."""
    return outlines if outlines.mask_path(name).exists() else photos
