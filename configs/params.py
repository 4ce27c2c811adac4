"""Every setting there is: typed, bounded, described with its unit. `load.py` fills them from presets and the user.

Device, worker count, paths and verbosity are not settings: they never change a result, so they never enter a
fingerprint.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

from configs.section import Section
from configs.texts import BALL_FORM, REGION_FORMS, read_ball, read_distance, read_region
from configs.training import MOST_PHOTOS, MOST_SEED, TrainParams

MOST_BALLS = 1000
MOST_SIDE = 65_536  # pixels: a gigapixel picture is 32,768 high


class IngestParams(Section):
    """Photos to upright RGB images."""

    max_side: int = Field(
        3200, ge=64, le=MOST_SIDE, description="photos larger than this are reduced to it, longest side in pixels"
    )
    min_images: int = Field(3, ge=2, le=MOST_PHOTOS, description="fewer usable photos than this is an error")
    video_frames: int = Field(
        80,
        ge=2,
        le=MOST_PHOTOS,
        description="at most this many frames of a video become photos: spread by motion, the sharpest ones",
    )
    auto_mask: Literal["off", "plain", "salient", "object"] = Field(
        "off",
        description="masks of photos without one. plain: from their plain background (black cloth, white sweep, chroma "
        "key), an error where it is not plain; salient: what a network takes for the subject, used where the photos "
        "agree on it to cut the mesh and find the region; object: the same, believed everywhere as masks of your own "
        "are, for an object that was moved; both need `pip install 'hineus[masks]'`",
    )
    panoramas: Literal["auto", "split", "off"] = Field(
        "auto",
        description="360-degree pictures (equirectangular) are split into pinhole views: eight around, one up. auto: "
        "by their metadata, or where the left and right borders of pictures twice as wide as high meet; split: all "
        "pictures twice as wide as high, too",
    )
    masks_keep: Literal["auto", "white", "black"] = Field(
        "auto",
        description="colour of the object in mask files; auto: white, and masks that seem inverted are an error. Alpha "
        "channels of photos keep what is opaque",
    )
    own_masks: bool = Field(
        True,
        description="use the masks that lie among the photos (IMG_1_mask.png, masks/IMG_1.png, ...) and alpha "
        "channels, where no `--masks` is given",
    )
    leave_out: tuple[str, ...] = Field(
        (), description="photos that no stage sees, as names or patterns (test_*.jpg) relative to the photo folder"
    )


class SfmParams(Section):
    """Images to camera poses (COLMAP)."""

    matcher: Literal["auto", "preemptive", "exhaustive", "sequential", "spatial"] = Field(
        "auto",
        description="which image pairs are matched; preemptive: only pairs whose largest features match; sequential, "
        "spatial: COLMAP's neighbours in name or in space; auto: preemptive",
    )
    preemptive_max: int = Field(
        150,
        ge=2,
        le=MOST_PHOTOS,
        description="up to so many photos preemptive compares all pairs; of more, those near in space (GPS), next in "
        "name or alike. More views of 360-degree pictures than this are matched with neighbours only",
    )
    mapper: Literal["incremental", "global", "hierarchical"] = Field(
        "incremental",
        description="how poses are solved; incremental: one photo after another; global: all at once; hierarchical: "
        "incremental in overlapping clusters of photos, which are merged",
    )
    wanted: float = Field(
        0.95,
        ge=0,
        le=1,
        description="other ways are tried, one after another, until this part of the photos has a pose; 0: only the "
        "first way",
    )
    masks: Literal["auto", "always", "never"] = Field(
        "auto",
        description="features on the object only, where masks exist; auto: where too few photos have a pose without. "
        "always: for an object that was moved, as `--moving-object` says",
    )
    max_image_size: int = Field(
        1600, ge=100, le=MOST_SIDE, description="features are found at this longest side, pixels"
    )
    max_features: int = Field(8192, ge=100, le=1_000_000, description="SIFT features per image")
    camera_model: Literal["SIMPLE_RADIAL", "RADIAL", "OPENCV", "SIMPLE_PINHOLE", "PINHOLE"] = Field(
        "SIMPLE_RADIAL", description="COLMAP camera model that is estimated"
    )
    refine_lens: Literal["auto", "off"] = Field(
        "auto",
        description="a last bundle adjustment of found poses; auto: frees each camera's principal point and radial k2 "
        "where observations held out of it are met better. off: what mapping found stays",
    )
    min_registered: int = Field(3, ge=2, le=MOST_PHOTOS, description="fewer registered photos than this is an error")
    min_registered_ratio: float = Field(
        0.3, ge=0, le=1, description="registering a smaller part of the photos than this is an error"
    )
    deterministic: bool = Field(
        False, description="single-threaded matching and mapping: same result every time, slower"
    )
    seed: int = Field(0, ge=0, le=MOST_SEED, description="random seed")


class PlaceParams(Section):
    """How the frame of the poses lies in the world: metres, place on Earth, up; and a region in its coordinates."""

    region: str = Field(
        "auto",
        description=f"region of interest: {REGION_FORMS}, in the coordinates of the exported PLY and OBJ; "
        "a box also crops the mesh",
    )
    up: Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"] = Field(
        "auto", description="up axis in the world frame; auto: from control points, GPS, the ground or the cameras"
    )
    gps: bool = Field(
        True, description="where the photos' GPS positions agree with the cameras, the world is metric, x east, y north"
    )
    control_epsg: int | None = Field(
        None,
        ge=1024,
        le=999999,
        description="EPSG code of the coordinates in `--control FILE`, over the one that the file names; needs "
        "`pip install 'hineus[geo]'`",
    )
    epsg: int | None = Field(
        None,
        ge=1024,
        le=999999,
        description="EPSG code of a map's grid in metres (32632: UTM zone 32 north) for the results, less an "
        "offset; null: metres east, north and up of an origin",
    )
    marker_size: float | None = Field(
        None,
        ge=1e-4,
        le=1000,
        description="side of printed ArUco markers in the scene, metres; their size gives the scale",
    )
    marker_dictionary: Literal[
        "4X4_50", "4X4_250", "5X5_100", "5X5_250", "6X6_250", "7X7_250", "ARUCO_ORIGINAL", "APRILTAG_36h11"
    ] = Field("4X4_50", description="the dictionary the markers are from")
    known_distance: str | None = Field(
        None,
        description="two points and the distance between them, 'X1 Y1 Z1 X2 Y2 Z2 METRES', in the coordinates of the "
        "PLY or OBJ exported without this setting; gives the scale",
    )

    @field_validator("region")
    @classmethod
    def _is_region(cls, text: str) -> str:
        read_region(text)
        return text

    @field_validator("known_distance")
    @classmethod
    def _is_distance(cls, text: str | None) -> str | None:
        if text is not None:
            read_distance(text)
        return text


class UndistortParams(Section):
    """Camera poses to pinhole images in a normalised frame."""

    max_side: int = Field(1600, ge=64, le=MOST_SIDE, description="longest side of the undistorted images, pixels")
    mask_erode: int = Field(
        0,
        ge=0,
        le=1000,
        description="masks shrink by this many pixels (at the undistorted size), and the object with them",
    )
    masks: Literal["auto", "alone", "beside"] = Field(
        "auto",
        description="alone: what is off the masks is not looked at; beside: whole photos count, and masks say where "
        "the object ends; auto: beside where the background stood still, by the points found on it. Masks of "
        "`ingest.auto_mask=salient` are always beside",
    )
    roi_scale: float = Field(
        1.0, ge=0.01, le=100, description="the region of interest found automatically is scaled by this"
    )
    subject: int = Field(
        1,
        ge=1,
        le=1000,
        description="where photos are about things far apart: which of them; 1 is what most photos are about",
    )


class DensifyParams(Section):
    """Pinhole images to depth maps and a point cloud."""

    method: Literal["auto", "patch_match", "off"] = Field(
        "auto",
        description="auto: semi-global matching of neighbouring photos; patch_match: COLMAP's, which needs a GPU and a "
        "pycolmap that was built with CUDA, and was never tried on one; off: no dense points",
    )
    side: int = Field(1000, ge=64, le=MOST_SIDE, description="photos are compared at this longest side, pixels")
    neighbors: int = Field(
        4, ge=2, le=20, description="photos that each photo is compared with: two must agree on a depth"
    )


class HeldOutDensifyParams(DensifyParams):
    """With `train.hold_out`, as it reaches the stage: photos held out from training make no dense points either."""

    hold_out: int = Field(
        0, ge=0, le=MOST_PHOTOS, description="every n-th photo is left out, as in `train.hold_out`; 0: none"
    )


class ExtractParams(Section):
    """Neural field to mesh."""

    resolution: int = Field(
        512,
        ge=16,
        le=2048,
        description="grid cells along the region of interest's side, fewer where photos show no more",
    )
    block: int = Field(64, ge=8, le=256, description="cells along a side of the blocks evaluated at a time")
    fit: bool = Field(True, description="move the mesh, by parts of a cell, to where dense points of many photos lie")
    denoising: int = Field(
        5, ge=0, le=50, description="rounds of a filter that makes planes flat and keeps edges sharp; 0: none"
    )


class CleanupParams(Section):
    """Raw mesh to a clean, light one."""

    target_faces: int = Field(100_000, ge=100, le=100_000_000, description="faces after decimation")
    min_component: float = Field(
        0.002, ge=0, le=1, description="pieces with fewer faces than this part of the largest piece are dropped"
    )
    min_views: int = Field(1, ge=0, le=MOST_PHOTOS, description="faces seen by fewer cameras than this count as unseen")
    keep_closed: bool = Field(False, description="a closed mesh: keep unseen faces, and close what cuts leave open")
    rings: int = Field(
        3, ge=0, le=1000, description="faces within this many steps of a seen one are kept, so borders are not ragged"
    )
    max_hidden_area: float = Field(
        0.002, ge=0, le=1, description="unseen patches up to this part of the seen area are kept: they close small gaps"
    )
    roi_radius: float = Field(
        0.98, gt=0, le=1, description="faces farther from the centre are dropped, in radii of the region of interest"
    )
    remove_ground: bool = Field(False, description="cut off the ground or table, where its plane was found")
    ground_tolerance: float = Field(
        0.015,
        gt=0,
        le=1,
        description="the cut is this far above the ground's plane, in radii of the region of interest",
    )
    mask_hull: bool = Field(True, description="where masks exist, drop faces that lie outside them")
    mask_margin: int = Field(
        6, ge=0, le=1000, description="masks grow by this many pixels before faces outside them are dropped"
    )
    mask_outside: float = Field(
        0.15,
        ge=0,
        le=1,
        description="a face is outside if it lies off the mask in more than this part of the photos; at least 0.3 "
        "where whole photos count beside the masks (a background that stood still; `ingest.auto_mask=salient`)",
    )


class AtlasParams(Section):
    """Mesh to UV charts."""

    texture_size: int | None = Field(
        None, ge=64, le=16384, description="side of the texture, pixels; null: as large as the photos can fill"
    )
    method: Literal["uvatlas", "xatlas"] = Field(
        "uvatlas",
        description="what makes the charts: uvatlas few and large ones, xatlas many small ones in less time",
    )
    padding: int = Field(4, ge=1, le=64, description="texels kept free between charts")
    time_limit: float = Field(
        120.0,
        gt=0,
        le=1_000_000,
        description="seconds of CPU time for each way to charts, then the next takes over: uvatlas, xatlas, projection",
    )


class BakeParams(Section):
    """Photos to texture."""

    views: int = Field(24, ge=1, le=32, description="photos blended, the best ones for each texel")
    detail: bool = Field(True, description="add the high band of the photos that resolve the most")
    gain: bool = Field(True, description="compensate brightness between photos")
    diffuse: bool = Field(
        False, description="count photos that show a point brighter than the others do less: fewer highlights"
    )
    robust_sigma: float = Field(
        6.0, ge=0.01, le=1000, description="colours further than this many (robust) standard deviations are rejected"
    )
    normal_map: bool = Field(True, description="keep the detail that decimation takes away as a normal map")
    occlusion_rays: int = Field(64, ge=0, le=4096, description="rays per sample of the occlusion map; 0: no such map")
    occlusion_reach: float = Field(
        0.5, ge=1e-4, le=100, description="what lies further off occludes nothing, in radii of the region of interest"
    )


class MaterialsParams(Section):
    """Textured mesh and photos to materials and light."""

    enabled: bool = Field(
        False, description="learn base colour without light in it, roughness, metalness, and the light of the photos"
    )
    light_turn: float | None = Field(
        None,
        ge=-360,
        le=360,
        description="degrees by which the light that is given is turned about the vertical; null: it is searched for, "
        "and 0 for the light of balls",
    )
    balls: tuple[str, ...] = Field(
        (),
        max_length=MOST_BALLS,
        description=f"balls in photos that tell the light, each as {BALL_FORM}: the circle around it in pixels of the "
        "upright photo, from its upper left corner, in its full size",
    )

    @field_validator("balls")
    @classmethod
    def _are_balls(cls, texts: tuple[str, ...]) -> tuple[str, ...]:
        for text in texts:
            read_ball(text)
        return texts


class SplatsParams(Section):
    """Photos and textured mesh to Gaussians on the surface."""

    enabled: bool = Field(False, description="make Gaussian splats, whose colours change with the direction")
    count: int | None = Field(
        None,
        ge=1000,
        le=1_000_000,
        description="Gaussians that are placed; refining adds some; null: as many as a typical photo has pixels of the "
        "surface, from 20,000 to 150,000",
    )
    steps: int = Field(
        600,
        ge=0,
        le=1_000_000,
        description="photos that they are refined by, one after the other; 0: colours by least squares alone",
    )
    background: bool = Field(
        False,
        description="also free ones, up to as many again, where dense points lie off the mesh: thin things, and what "
        "is around the subject",
    )


class ExportParams(Section):
    """Textured mesh, and dense points, to files."""

    formats: tuple[Literal["glb", "usdz", "obj", "ply", "stl", "points", "orthophoto"], ...] = Field(
        ("glb", "usdz", "obj", "ply"),
        description="files to write; stl is the bare shape, points the dense points as PLY and LAZ, orthophoto the "
        "model from above and its heights as GeoTIFF, for which it takes `pip install 'hineus[survey]'`",
    )
    points_trust: float = Field(
        0.5, ge=0, le=1, description="dense points that are trusted less, from 0 to 1, are left out of their files"
    )
    points_from: Literal["region", "everywhere"] = Field(
        "region",
        description="which dense points: those in the region of interest, as of the mesh, or all",
    )
    lods: int = Field(
        0, ge=0, le=4, description="lighter GLBs with the same textures, each with half the faces of the one before"
    )
    tiles: bool = Field(
        False, description="3D Tiles for viewers of maps: tileset.json over the GLB and the levels of `export.lods`"
    )
    heights: Literal["sea_level", "ellipsoid"] = Field(
        "sea_level",
        description="what GPS altitudes and control points' heights count from; sea_level: on the Earth (3D Tiles, "
        "georeference.json, metadata.xml) the model is raised by the geoid, EGM2008, which `pip install "
        "'hineus[survey]'` brings; ellipsoid (WGS 84): it stands there as it is, see `docs/howto.md`",
    )
    ground_resolution: float | None = Field(
        None,
        gt=0,
        le=1e6,
        description="side of a pixel of the orthophoto and the surface model, metres (or what unit the results have); "
        "null: what a pixel of the photos covers of the ground",
    )
    splats: tuple[Literal["ply", "spz", "glb"], ...] = Field(
        ("ply", "spz", "glb"),
        description="files of Gaussian splats, where `splats.enabled` made some: ply as 3DGS writes it, spz a quarter "
        "as large or less, glb with KHR_gaussian_splatting",
    )
    splat_lods: int = Field(
        0, ge=0, le=4, description="lighter files of splats, each with half the Gaussians of the one before"
    )
    collision: Literal["off", "hulls"] = Field(
        "off", description="a GLB of convex pieces for physics engines; needs `pip install coacd`"
    )
    simulation: Literal["off", "usd"] = Field(
        "off",
        description="a USDZ for simulators: mesh, material, convex pieces with UsdPhysics' collision, and the light "
        "where `materials.enabled` found it; needs `pip install coacd`",
    )
    collision_pieces: int = Field(16, ge=1, le=256, description="at most this many convex pieces")


class ReportParams(Section):
    """Everything to one HTML page."""

    thumbnails: int = Field(300, ge=0, le=MOST_PHOTOS, description="at most this many photos have a thumbnail")


class Config(Section):
    """All settings of a run."""

    ingest: IngestParams = IngestParams()
    sfm: SfmParams = SfmParams()
    place: PlaceParams = PlaceParams()
    undistort: UndistortParams = UndistortParams()
    densify: DensifyParams = DensifyParams()
    train: TrainParams = TrainParams()
    extract: ExtractParams = ExtractParams()
    cleanup: CleanupParams = CleanupParams()
    atlas: AtlasParams = AtlasParams()
    bake: BakeParams = BakeParams()
    materials: MaterialsParams = MaterialsParams()
    splats: SplatsParams = SplatsParams()
    export: ExportParams = ExportParams()
    report: ReportParams = ReportParams()
