"""Settings of COLMAP's features, matches and mapper, the same whether poses are found or known."""

from __future__ import annotations

from typing import Any

from stages.posing.evidence import MIN_VERIFIED

# Affine features are also looked for where there is less contrast, this many times the usual threshold.
AFFINE_PEAK = 0.5
# A match is stationary when it lies at the same place in both photos, within this many pixels (COLMAP's default).
STATIONARY_PX = 4.0


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


def verification_options(params: Any, verified: int = MIN_VERIFIED, moving: bool = False) -> Any:
    """What makes a pair of photos believed.

    Args:
        params: `configs.params.SfmParams`.
        verified: so many matches that fit one epipolar geometry.
        moving: matches at the same place of both photos do not count.
    """
    import pycolmap

    options = pycolmap.TwoViewGeometryOptions()
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
