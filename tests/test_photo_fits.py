"""How well photos fit the points they see, on a model that pycolmap makes up."""

from __future__ import annotations

import numpy as np
import pytest

from stages.posing.photo_fits import photo_fits


@pytest.fixture
def model(tmp_path):
    import pycolmap

    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_frames_per_rig, options.num_points3D = 5, 60
    made = pycolmap.synthesize_dataset(options)
    made.write(tmp_path)
    return made, tmp_path


def test_a_perfect_model_has_no_error(model):
    made, folder = model
    fits = photo_fits(folder)
    assert set(fits) == {image.name for image in made.images.values()}
    for fit in fits.values():
        assert fit.points > 20
        assert fit.error_px == pytest.approx(0, abs=1e-6)


def test_a_photo_whose_features_are_off_is_told_from_the_others(model):
    made, folder = model
    image = made.images[2]
    for point in image.points2D:
        point.xy = np.asarray(point.xy) + np.array([3, 4])
    made.write(folder)
    fits = photo_fits(folder)
    assert fits.pop(image.name).error_px == pytest.approx(5, abs=1e-6)
    assert max(fit.error_px for fit in fits.values()) < 1e-6


def test_a_folder_without_a_model_is_refused(tmp_path):
    with pytest.raises(ValueError, match="expected a COLMAP model"):
        photo_fits(tmp_path)
