"""Every setting there is: typed, bounded, described with its unit. `load.py` fills them from presets and the user.

Device, worker count, paths and verbosity are not settings: they never change a result, so they never enter a
fingerprint.
"""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from configs.texts import REGION_FORMS, read_distance, read_region


class Section(BaseModel):
    """A frozen group of settings; unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class IngestParams(Section):
    """Photos to upright RGB images."""

    max_side: int = Field(3200, ge=64, description="photos larger than this are reduced to it, longest side in pixels")
    min_images: int = Field(3, ge=2, description="fewer usable photos than this is an error")
    video_frames: int = Field(
        80, ge=2, description="at most this many frames of a video become photos: spread by motion, the sharpest ones"
    )
    auto_mask: Literal["off", "plain"] = Field(
        "off",
        description="plain: photos without a mask get one from their plain background (black cloth, white sweep, "
        "chroma key); an error where it is not plain",
    )
    leave_out: tuple[str, ...] = Field(
        (), description="photos that no stage sees, as names or patterns (test_*.jpg) relative to the photo folder"
    )


class SfmParams(Section):
    """Images to camera poses (COLMAP)."""

    matcher: Literal["auto", "exhaustive", "sequential", "spatial"] = Field(
        "auto", description="which image pairs are matched; auto: exhaustive up to `exhaustive_max` photos"
    )
    exhaustive_max: int = Field(150, ge=2, description="auto matches all pairs up to this many photos")
    mapper: Literal["incremental", "global"] = Field("incremental", description="how poses are solved")
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
        "always: for an object that was turned by hand",
    )
    max_image_size: int = Field(1600, ge=100, description="features are found at this longest side, pixels")
    max_features: int = Field(8192, ge=100, description="SIFT features per image")
    camera_model: Literal["SIMPLE_RADIAL", "RADIAL", "OPENCV", "SIMPLE_PINHOLE", "PINHOLE"] = Field(
        "SIMPLE_RADIAL", description="COLMAP camera model that is estimated"
    )
    min_registered: int = Field(3, ge=2, description="fewer registered photos than this is an error")
    min_registered_ratio: float = Field(
        0.3, ge=0, le=1, description="registering a smaller part of the photos than this is an error"
    )
    deterministic: bool = Field(
        False, description="single-threaded matching and mapping: same result every time, slower"
    )
    seed: int = Field(0, ge=0, description="random seed")


class PlaceParams(Section):
    """How the frame of the poses lies in the world: metres, place on Earth, up; and a region in its coordinates."""

    region: str = Field(
        "auto",
        description=f"region of interest: {REGION_FORMS}, in the coordinates of the exported PLY and OBJ; "
        "a box also crops the mesh",
    )
    up: Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"] = Field(
        "auto", description="up axis in the world frame; auto: from GPS, the ground or the cameras"
    )
    gps: bool = Field(
        True, description="where the photos' GPS positions agree with the cameras, the world is metric, x east, y north"
    )
    marker_size: float | None = Field(
        None, gt=0, description="side of printed ArUco markers in the scene, metres; their size gives the scale"
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

    max_side: int = Field(1600, ge=64, description="longest side of the undistorted images, pixels")
    mask_erode: int = Field(
        0, ge=0, description="masks shrink by this many pixels (at the undistorted size), and the object with them"
    )
    roi_scale: float = Field(1.0, gt=0, description="the region of interest found automatically is scaled by this")


class ExtractParams(Section):
    """Neural field to mesh."""

    resolution: int = Field(256, ge=16, le=2048, description="grid cells along the region of interest's side")
    block: int = Field(64, ge=8, le=256, description="cells along a side of the blocks evaluated at a time")


class CleanupParams(Section):
    """Raw mesh to a clean, light one."""

    target_faces: int = Field(100_000, ge=100, description="faces after decimation")
    min_component: float = Field(
        0.002, ge=0, le=1, description="pieces with fewer faces than this part of the largest piece are dropped"
    )
    min_views: int = Field(1, ge=0, description="faces seen by fewer cameras than this count as unseen")
    keep_closed: bool = Field(False, description="a closed mesh: keep unseen faces, and close what cuts leave open")
    rings: int = Field(
        3, ge=0, description="faces within this many steps of a seen one are kept, so borders are not ragged"
    )
    max_hidden_area: float = Field(
        0.002, ge=0, le=1, description="unseen patches up to this part of the seen area are kept: they close small gaps"
    )
    roi_radius: float = Field(
        0.98, gt=0, le=1, description="faces farther from the centre are dropped, in radii of the region of interest"
    )
    remove_ground: bool = Field(False, description="cut off the ground or table, where its plane was found")
    ground_tolerance: float = Field(
        0.015, gt=0, description="the cut is this far above the ground's plane, in radii of the region of interest"
    )
    mask_hull: bool = Field(True, description="where masks exist, drop faces that lie outside them")
    mask_margin: int = Field(
        6, ge=0, description="masks grow by this many pixels before faces outside them are dropped"
    )
    mask_outside: float = Field(
        0.15, ge=0, le=1, description="a face is outside if it lies off the mask in more than this part of the photos"
    )


class AtlasParams(Section):
    """Mesh to UV charts."""

    texture_size: int | None = Field(
        None, ge=64, le=16384, description="side of the texture, pixels; null: as large as the photos can fill"
    )
    padding: int = Field(4, ge=1, le=64, description="texels kept free between charts")
    time_limit: float = Field(120.0, gt=0, description="seconds before the fallback parametrisation takes over")


class BakeParams(Section):
    """Photos to texture."""

    views: int = Field(24, ge=1, le=32, description="photos blended, the best ones for each texel")
    detail: bool = Field(True, description="add the high band of the photos that resolve the most")
    gain: bool = Field(True, description="compensate brightness between photos")
    diffuse: bool = Field(
        False, description="count photos that show a point brighter than the others do less: fewer highlights"
    )
    robust_sigma: float = Field(
        6.0, gt=0, description="colours further than this many (robust) standard deviations are rejected"
    )
    normal_map: bool = Field(True, description="keep the detail that decimation takes away as a normal map")
    occlusion_rays: int = Field(64, ge=0, le=4096, description="rays per sample of the occlusion map; 0: no such map")
    occlusion_reach: float = Field(
        0.5, gt=0, description="what lies further off occludes nothing, in radii of the region of interest"
    )


class ExportParams(Section):
    """Textured mesh to files."""

    formats: tuple[Literal["glb", "usdz", "obj", "ply", "stl"], ...] = Field(
        ("glb", "usdz", "obj", "ply"), description="files to write; stl is the bare shape"
    )
    lods: int = Field(
        0, ge=0, le=4, description="lighter GLBs with the same textures, each with half the faces of the one before"
    )
    collision: Literal["off", "hulls"] = Field(
        "off", description="a GLB of convex pieces for physics engines; needs `pip install coacd`"
    )
    collision_pieces: int = Field(16, ge=1, le=256, description="at most this many convex pieces")


class ReportParams(Section):
    """Everything to one HTML page."""

    thumbnails: int = Field(300, ge=0, description="at most this many photos have a thumbnail")


class TrainParams(Section):
    """Posed images to a neural signed distance field."""

    steps: int = Field(8000, ge=1, description="optimiser steps (ignored where `minutes` is set)")
    minutes: float | None = Field(None, gt=0, description="wall-clock budget in minutes instead of steps")
    seed: int = Field(0, ge=0, description="random seed")
    holdout: int = Field(
        0,
        ge=0,
        description="keep every n-th photo back from training and texture, and report the PSNR on those; 0: none",
    )
    rays: int = Field(512, ge=1, description="rays per step")
    samples: int = Field(16, ge=2, description="samples per ray inside the region of interest")
    precision: Literal["auto", "float32", "mixed"] = Field(
        "auto",
        description="matrix products of the networks: float32, or bfloat16 for colours and, on CUDA, TF32 for the "
        "distance; auto: mixed on CUDA only, from Ampere on",
    )
    free_points: int = Field(256, ge=0, description="points per step anywhere in the region, for the Eikonal term")

    backbone: Literal["hineus", "neus2", "hfneus", "neuralangelo"] = Field(
        "hineus", description="set density, gradients, encoding and schedules as that method does; what is named wins"
    )
    encoding: Literal["hash", "frequency"] = Field("hash", description="encoding of positions for the SDF")
    levels: int = Field(8, ge=1, le=24, description="levels of the SDF's hash encoding, or its frequencies")
    level_features: int = Field(4, ge=1, le=8, description="features per level; CPU kernels exist for 4")
    log2_rows: int = Field(17, ge=8, le=24, description="a level has at most two to this power rows")
    coarsest: int = Field(16, ge=2, description="cells along a side of the coarsest level")
    finest: int = Field(512, ge=4, le=8192, description="cells along a side of the finest level")
    start_levels: int = Field(4, ge=1, description="levels in use at the start")
    coarse_until: float = Field(0.4, ge=0, le=1, description="progress at which all levels are in use")
    sdf_layers: int = Field(1, ge=1, le=16, description="hidden layers of the SDF's MLP")
    sdf_width: int = Field(64, ge=4, description="width of the SDF's hidden layers")
    radiance_layers: int = Field(2, ge=1, le=16, description="hidden layers of the radiance MLP")
    radiance_width: int = Field(64, ge=4, description="width of the radiance MLP's hidden layers, and of the others")
    radiance_inputs: Literal["view", "reflected"] = Field(
        "reflected",
        description="what the radiance MLP knows of the view: its direction, or the reflected one and n.v too",
    )
    gradients: Literal["analytic", "numerical"] = Field(
        "analytic", description="SDF gradients by differentiation, or central differences one active voxel to each side"
    )
    sphere_radius: float = Field(0.5, gt=0, lt=1, description="the SDF is this sphere before training, scene units")
    init: Literal["auto", "sphere", "room", "hull"] = Field(
        "auto",
        description="the SDF before training: that sphere, a room around the cameras, or the visual hull of masks (one "
        "for each photo); auto: a room where most cameras stand in that sphere, else it",
    )

    density: Literal["laplace", "neus"] = Field(
        "laplace", description="optical depth from the SDF: Laplace CDF (VolSDF), or the logistic alpha of NeuS"
    )
    scale: Literal["scheduled", "learned"] = Field("scheduled", description="how the density's scale b gets its value")
    scale_start: float = Field(0.05, gt=0, description="scale b at the start, scene units")
    scale_end: float = Field(
        0.002, gt=0, description="scheduled scale b at the end, scene units; never under half a voxel"
    )
    sharpen_until: float = Field(0.9, gt=0, le=1, description="progress at which the scheduled scale is at its end")

    lr_table: float = Field(1e-2, gt=0, description="peak learning rate of the hash tables")
    lr_network: float = Field(3e-3, gt=0, description="peak learning rate of the networks")
    lr_warm_up: float = Field(0.02, ge=0, lt=1, description="progress at which the peak rate is reached")
    lr_decay: Literal["cosine", "exponential"] = Field("cosine", description="how the rate falls after that")
    lr_final: float = Field(0.03, gt=0, le=1, description="rate at the end as a part of the peak")
    adam_beta2: float = Field(0.99, gt=0, lt=1, description="Adam's decay of the squared gradients")

    weight_eikonal: float = Field(0.1, ge=0, description="weight of the Eikonal term")
    eikonal_start: float = Field(
        1.0, gt=0, description="the Eikonal term is scaled by this at the start, then on a log scale to `eikonal_end`"
    )
    eikonal_end: float = Field(1.0, gt=0, description="the Eikonal term is scaled by this at the end")
    weight_sparse: float = Field(1.0, ge=0, description="weight of the SfM points' terms, faded out")
    sparse_until: float = Field(0.8, ge=0, le=1, description="progress at which the SfM points' term is gone")
    sparse_tolerance: float = Field(0.005, gt=0, description="SfM points off by this count linearly, scene units")
    sparse_step: float = Field(
        0.01, ge=0, description="the SDF must have changed sign this far before and behind SfM points, scene units"
    )
    sparse_batch: int = Field(256, ge=0, description="sightings of SfM points per step")
    weight_mask: float = Field(0.1, ge=0, description="weight of the mask term, where masks exist")
    weight_exposure: float = Field(0.1, ge=0, description="weight that holds the photos' gains at 1")

    ambiguity: Literal["off", "paper", "stable"] = Field(
        "off", description="trust photos less where the others that see a place disagree with them"
    )
    ambiguity_from: float = Field(0.2, ge=0, le=1, description="progress at which the stable form begins")
    visibility: Literal["network", "paper", "stable", "mesh"] = Field(
        "stable",
        description="how the ambiguity weight finds out which photos see a place: the paper's product over the SDF "
        "network or (`paper`) over its cached grid, the smallest SDF on the path, or rays cast at a mesh",
    )
    visibility_sharpness: float = Field(100.0, gt=0, description="sigmoid sharpness beta, per scene unit")
    visibility_samples: int = Field(64, ge=2, description="samples on a path; the CPU's stable form traces instead")

    reflection: Literal["off", "paper", "stable"] = Field(
        "off", description="explain what a surface mirrors of the object itself by a second surface"
    )
    reflection_from: float = Field(0.3, ge=0, le=1, description="progress at which the stable form begins")
    reflection_reach: float = Field(0.1, gt=0, description="length t_max of reflected rays, scene units")
    reflection_samples: int = Field(16, ge=2, description="samples on a reflected ray")
    reflection_temperature: float = Field(
        10.0, gt=0, description="the paper's form: inverse scale of its Laplace CDF, per scene unit"
    )

    planar: Literal["off", "paper", "stable"] = Field(
        "off", description="hold the SDF to be linear around surface points of even appearance"
    )
    planar_features: Literal["radiance", "mlp"] = Field(
        "radiance", description="appearance features: those the radiance MLP gets, or those of an MLP of its own"
    )
    weight_planar: float = Field(1.0, ge=0, description="weight of the planar term")
    planar_start: float = Field(0.1, gt=0, le=1, description="lambda_pla is scaled by this at the start and by 1 later")
    planar_radius: float = Field(
        0.05, gt=0, description="reach of the planar term at the start, scene units; three voxels at the end"
    )
    planar_rays: int = Field(256, ge=1, description="rays per step that the planar term looks at")
    planar_neighbors: int = Field(4, ge=1, description="places around each of their surface points")
    planar_until: float = Field(1.0, gt=0, le=1, description="progress from which lambda_pla is not scaled down")

    weight_consistency: float = Field(
        0.0, ge=0, description="weight of the term that compares patches of the photos with each other; 0: off"
    )
    consistency_from: float = Field(0.4, ge=0, le=1, description="progress at which that term begins")
    consistency_rays: int = Field(128, ge=1, description="rays per step that it looks at")

    eikonal: Literal["plain", "paper", "stable"] = Field(
        "plain", description="hold the SDF's gradient to length 1 evenly, or less where the photos are not met yet"
    )
    relaxation_gamma: float = Field(5.0, ge=0, description="how fast colour error relaxes the Eikonal term")
    relaxation_clip: float = Field(0.2, gt=0, description="colour error from which it relaxes no further")

    sampler: Literal["grid", "proposal"] = Field(
        "grid", description="where samples go: near the surface of a cached grid, or as a proposal network says"
    )
    proposal_samples: int = Field(64, ge=2, description="samples per ray of the proposal network")
    proposal_updates: int = Field(
        128, ge=0, description="steps at the start that each train the proposal network; later every fifth does"
    )

    background: bool = Field(True, description="model what lies outside the region (never where masks exist)")
    background_samples: int = Field(16, ge=1, description="samples per ray outside the region")
    background_log2_rows: int = Field(15, ge=8, le=24, description="rows per level of the background's encoding")

    cache_resolution: int = Field(96, ge=8, le=512, description="side of the SDF grid that guides sampling")
    cache_every: int = Field(64, ge=1, description="steps between refreshes of that grid")
    preview_every: float = Field(0.25, gt=0, le=1, description="progress between preview renders")


class Config(Section):
    """All settings of a run."""

    ingest: IngestParams = IngestParams()
    sfm: SfmParams = SfmParams()
    place: PlaceParams = PlaceParams()
    undistort: UndistortParams = UndistortParams()
    train: TrainParams = TrainParams()
    extract: ExtractParams = ExtractParams()
    cleanup: CleanupParams = CleanupParams()
    atlas: AtlasParams = AtlasParams()
    bake: BakeParams = BakeParams()
    export: ExportParams = ExportParams()
    report: ReportParams = ReportParams()
