"""Settings of COLMAP's features, matches and mapper, the same whether poses are found or known."""

from __future__ import annotations

from typing import Any

from stages.posing.evidence import MIN_VERIFIED

# Affine features are also looked for where there is less contrast, this many times the usual threshold.
AFFINE_PEAK = 0.5
# A match is stationary when it lies at the same place in both photos, within this many pixels (COLMAP's default).
STATIONARY_PX = 4.0
# Corners are exact to a part of a pixel, and few: pixels within which they agree with an epipolar geometry, with a 3D
# point, and at first with a photo's position; degrees between lines of sight that may still be the same point.
CORNER_EPIPOLAR_PX, CORNER_POINT_PX, CORNER_POSE_PX, CORNER_ANGLE_DEG = 2.0, 2.0, 4.0, 0.5
CORNER_INIT_INLIERS, CORNER_INIT_ANGLE_DEG = 20, 6.0
CORNER_TRIALS = 1000  # of RANSAC: most pairs of an object's photos show other sides of it


def device(cuda: bool) -> Any:
    """COLMAP's name of the GPU or the CPU."""
    import pycolmap

    return pycolmap.Device.cuda if cuda else pycolmap.Device.cpu


def feature_options(params: Any, workers: int, cuda: bool, affine: bool = False) -> dict[str, Any]:
    """Arguments of `pycolmap.extract_features`.

    Args:
        params: `configs.params.SfmParams`.
        workers: threads; finding features is deterministic with any number of them.
        affine: features that follow tilted surfaces, and fainter ones; on the CPU only.
    """
    import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size, options.num_threads = params.max_image_size, workers
    options.sift.max_num_features = params.max_features
    if affine:
        options.sift.estimate_affine_shape = True
        options.sift.peak_threshold *= AFFINE_PEAK
    options.use_gpu = cuda and not affine
    return {"extraction_options": options, "device": device(options.use_gpu)}


def match_options(
    params: Any, threads: int, cuda: bool, guided: bool = False, verified: int = MIN_VERIFIED, moving: bool = False
) -> dict[str, Any]:
    """Arguments of pycolmap's matchers.

    Args:
        params: `configs.params.SfmParams`.
        threads: one for the same matches every time.
        guided, verified, moving: see `verification_options`; guided: look for more along the epipolar lines found.
    """
    import pycolmap

    options = pycolmap.FeatureMatchingOptions()
    options.num_threads, options.use_gpu, options.guided_matching = threads, cuda, guided
    verification = verification_options(params, verified, moving)
    return {"matching_options": options, "verification_options": verification, "device": device(cuda)}


def verification_options(params: Any, verified: int = MIN_VERIFIED, moving: bool = False, corners: bool = False) -> Any:
    """What makes a pair of photos believed.

    Args:
        params: `configs.params.SfmParams`.
        verified: so many matches that fit one epipolar geometry.
        moving: matches at the same place of both photos do not count.
        corners: features are corners.
    """
    import pycolmap

    options = pycolmap.TwoViewGeometryOptions()
    if corners:
        options.ransac.max_error, options.ransac.max_num_trials = CORNER_EPIPOLAR_PX, CORNER_TRIALS
    options.min_num_inliers, options.ransac.random_seed = verified, params.seed
    options.filter_stationary_matches, options.stationary_matches_max_error = moving, STATIONARY_PX
    return options


def mapping_options(params: Any, threads: int) -> Any:
    """`pycolmap.IncrementalPipelineOptions` with the seeds and without what is not needed."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = threads
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = params.seed
    options.extract_colors = False
    return options


def expect_corners(options: Any, verified: int) -> None:
    """Set `pycolmap.IncrementalPipelineOptions` for features that are corners; verified: matches a pair needs."""
    options.min_num_matches = verified
    options.structure_less_registration_fallback = False  # few corners are no ground for a pose without points
    mapper, triangulation = options.mapper, options.triangulation
    mapper.init_min_num_inliers, mapper.init_min_tri_angle = CORNER_INIT_INLIERS, CORNER_INIT_ANGLE_DEG
    mapper.init_max_error = CORNER_EPIPOLAR_PX
    mapper.abs_pose_max_error, mapper.filter_max_reproj_error = CORNER_POSE_PX, CORNER_POINT_PX
    triangulation.create_max_angle_error = triangulation.continue_max_angle_error = CORNER_ANGLE_DEG
    triangulation.merge_max_reproj_error = triangulation.complete_max_reproj_error = CORNER_POINT_PX
