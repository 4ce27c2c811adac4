"""The pipeline: an ordered tuple of stages. Read it as the table of contents."""

from __future__ import annotations

from typing import Any

from stages.atlas import ATLAS
from stages.bake import BAKE
from stages.cleanup import CLEANUP
from stages.densify import DENSIFY
from stages.engine.stage import Stage
from stages.export import EXPORT
from stages.extract import EXTRACT
from stages.ingest import INGEST
from stages.materials import MATERIALS
from stages.place import PLACE
from stages.report import REPORT
from stages.sfm import SFM
from stages.splats import SPLATTING
from stages.train import TRAIN
from stages.undistort import UNDISTORT

PIPELINE: tuple[Stage[Any], ...] = (
    INGEST,  # photos -> upright images
    SFM,  # images -> camera poses
    PLACE,  # poses -> metres, place and up of the world
    UNDISTORT,  # poses -> pinhole images in a normalised frame
    DENSIFY,  # pinhole images -> depth maps, a dense point cloud
    TRAIN,  # posed images -> neural signed distance field
    EXTRACT,  # field -> mesh
    CLEANUP,  # mesh -> clean, light mesh
    ATLAS,  # clean mesh -> UV charts
    BAKE,  # charts + photos -> texture
    MATERIALS,  # photos + texture -> materials and light
    SPLATTING,  # photos + textured mesh -> Gaussians on the surface
    EXPORT,  # textured mesh -> GLB, USDZ, OBJ, PLY, STL; points -> PLY, LAZ
    REPORT,  # everything -> one HTML page
)
