"""Every file of a workspace, one module for each stage's: its name, where it lies, how it is saved and loaded.

Nobody else spells a path. A stage declares the artifacts (upper case) that it reads and writes. Whoever looks at a
finished workspace loads them from the folder of the stage that owns them: `artifacts.SCENE.load(folder)`.
"""

from stages.artifacts.artifact import Artifact
from stages.artifacts.atlas import ATLAS_MESH, AtlasMesh
from stages.artifacts.bake import BASE_COLOR, GAINS, NORMAL_MAP, OCCLUSION, PROVENANCE, QUALITY, VertexQuality
from stages.artifacts.densify import DEPTH_MAPS, POINT_CLOUD, DepthMaps
from stages.artifacts.export import (
    ASSET,
    GEOREFERENCE,
    METADATA,
    ORTHOPHOTO,
    SURFACE_MODEL,
    TILESET,
    asset_path,
    collision_path,
    forget_overviews,
    light_path,
    lod_path,
    obj_map_path,
    overview_path,
    points_path,
    simulation_path,
    splats_path,
)
from stages.artifacts.ingest import IMAGE_SET, LEFT_OUT, PHOTOS, ImageRecord, ImageSet, SkippedImage
from stages.artifacts.json_files import read_json, write_json
from stages.artifacts.materials import KNOWN, LIGHT, LIGHT_HARMONICS, LIGHT_HDR, MATERIAL_COLOR, ORM
from stages.artifacts.mesh import AROUND_MESH, CLEAN_FULL_MESH, CLEAN_MESH, RAW_MESH
from stages.artifacts.pictures import IMAGES, MASKS, Pictures, read_texture, texture_bytes, write_png
from stages.artifacts.place import GIVEN_REGION, WORLD_PLACE, PlaceRecord, SimilarityRecord
from stages.artifacts.report import PAGE
from stages.artifacts.sfm import (
    FEATURES,
    GIVEN_POSES,
    MODEL,
    PHOTO_CONTENTS,
    REGISTRATION,
    GivenPoses,
    KnownSphere,
    Lens,
    LensTrial,
    PhotoContents,
    PhotoFile,
    PoseError,
    Registration,
    Unregistered,
)
from stages.artifacts.splats import SPLATS
from stages.artifacts.train import CAMERAS, FIELD, HELD_OUT, METRICS, PREVIEWS, SCENE, checkpoint_path, preview_path
from stages.artifacts.undistort import FIRST_SCENE, OUTLINES, PINHOLE_PHOTOS, SILHOUETTES, given_mask_of
