"""Every setting there is: typed, bounded, described with its unit. `load.py` fills them from presets and the user.

Device, worker count, paths and verbosity are not settings: they never change a result, so they never enter a fingerprint.
"""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class Section(BaseModel):
    """A frozen group of settings; unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class IngestParams(Section):
    """Photos to upright RGB images."""

    max_side: int = Field(3200, ge=64, description="photos larger than this are reduced to it, longest side in pixels")
    min_images: int = Field(3, ge=2, description="fewer usable photos than this is an error")


class SfmParams(Section):
    """Images to camera poses (COLMAP)."""

    matcher: Literal["auto", "exhaustive", "sequential", "spatial"] = Field(
        "auto", description="which image pairs are matched; auto: exhaustive up to `exhaustive_max` photos"
    )
    exhaustive_max: int = Field(150, ge=2, description="auto matches all pairs up to this many photos")
    mapper: Literal["incremental", "global"] = Field("incremental", description="how poses are solved")
    max_image_size: int = Field(1600, ge=100, description="features are found at this longest side, pixels")
    max_features: int = Field(8192, ge=100, description="SIFT features per image")
    camera_model: Literal["SIMPLE_RADIAL", "RADIAL", "OPENCV", "SIMPLE_PINHOLE", "PINHOLE"] = Field(
        "SIMPLE_RADIAL", description="COLMAP camera model that is estimated"
    )
    min_registered: int = Field(3, ge=2, description="fewer registered photos than this is an error")
    min_registered_ratio: float = Field(
        0.3, ge=0, le=1, description="registering a smaller part of the photos than this is an error"
    )
    deterministic: bool = Field(False, description="single-threaded matching and mapping: same result every time, slower")
    seed: int = Field(0, ge=0, description="random seed")


class UndistortParams(Section):
    """Camera poses to pinhole images in a normalised frame."""

    max_side: int = Field(1600, ge=64, description="longest side of the undistorted images, pixels")
    mask_erode: int = Field(2, ge=0, description="masks shrink by this many pixels (at the undistorted size)")
    roi_scale: float = Field(1.0, gt=0, description="the region of interest found automatically is scaled by this")
    up: Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"] = Field(
        "auto", description="up axis in the world frame; auto: from the cameras"
    )


class ExtractParams(Section):
    """Neural field to mesh."""

    resolution: int = Field(256, ge=16, le=2048, description="grid cells along the region of interest's side")
    block: int = Field(64, ge=8, le=256, description="cells along a side of the blocks evaluated at a time")


class CleanupParams(Section):
    """Raw mesh to a clean, light one."""

    target_faces: int = Field(100_000, ge=100, description="faces after decimation")
    min_component: float = Field(
        0.02, ge=0, le=1, description="pieces with fewer faces than this part of the largest piece are dropped"
    )
    min_views: int = Field(1, ge=0, description="faces seen by fewer cameras than this count as unseen")
    keep_closed: bool = Field(False, description="keep unseen faces that close the surface (watertight where possible)")


class AtlasParams(Section):
    """Mesh to UV charts."""

    texture_size: int = Field(2048, ge=64, le=16384, description="side of the texture, pixels")
    padding: int = Field(4, ge=1, le=64, description="texels kept free between charts")
    time_limit: float = Field(120.0, gt=0, description="seconds before the fallback parametrisation takes over")


class BakeParams(Section):
    """Photos to texture."""

    views: int = Field(5, ge=1, le=32, description="photos blended for the low band, the best ones for each texel")
    detail: bool = Field(True, description="add the high band of the single best photo")
    gain: bool = Field(True, description="compensate brightness between photos")
    robust_sigma: float = Field(
        2.5, gt=0, description="colours further than this many (robust) standard deviations are rejected"
    )


class ExportParams(Section):
    """Textured mesh to files."""

    formats: tuple[Literal["glb", "obj", "ply"], ...] = Field(("glb", "obj", "ply"), description="files to write")


class ReportParams(Section):
    """Everything to one HTML page."""

    thumbnails: int = Field(60, ge=0, description="at most this many photo thumbnails")


class TrainParams(Section):
    """Posed images to a neural signed distance field."""

    steps: int = Field(3000, ge=1, description="optimiser steps (ignored where `minutes` is set)")
    minutes: float | None = Field(None, gt=0, description="wall-clock budget in minutes instead of steps")
    seed: int = Field(0, ge=0, description="random seed")


class Config(Section):
    """All settings of a run."""

    ingest: IngestParams = IngestParams()
    sfm: SfmParams = SfmParams()
    undistort: UndistortParams = UndistortParams()
    train: TrainParams = TrainParams()
    extract: ExtractParams = ExtractParams()
    cleanup: CleanupParams = CleanupParams()
    atlas: AtlasParams = AtlasParams()
    bake: BakeParams = BakeParams()
    export: ExportParams = ExportParams()
    report: ReportParams = ReportParams()
