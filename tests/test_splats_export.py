"""Gaussian splats among the exported files: frames, levels, and what another program reads of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_up_gaussians import some_gaussians
from splat_readers import read_splats
from tetrahedron import WORLD, to_gltf, workspace

from configs.params import ExportParams
from stages import artifacts
from stages.engine.stage import StageContext
from stages.errors import ReconstructionError
from stages.export import EXPORT
from stages.gaussians.keeping import write_gaussians

GAUSSIANS = some_gaussians(300)


def with_splats(tmp_path: Path, **params: object) -> StageContext:
    context = workspace(tmp_path, ExportParams.model_validate({"formats": ("glb",), **params}))
    write_gaussians(artifacts.SPLATS.load(context.inputs["splats"]), GAUSSIANS)
    return context


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir() if "splats" in path.name}


def test_all_files_are_written_and_counted(tmp_path):
    context = with_splats(tmp_path)
    numbers = EXPORT.run(context)
    assert names(context.out) == {"model.splats.ply", "model.splats.spz", "model.splats.glb"}
    assert numbers["splats"] == 300
    for kind in ("ply", "spz", "glb"):
        assert artifacts.splats_path(context.out, kind).stat().st_size == numbers["bytes"][f"splats_{kind}"]


def test_levels_have_half_each(tmp_path):
    context = with_splats(tmp_path, splats=("spz",), splat_lods=2)
    numbers = EXPORT.run(context)
    assert names(context.out) == {"model.splats.spz", "model_lod1.splats.spz", "model_lod2.splats.spz"}
    assert numbers["splat_lods"] == pytest.approx([150, 75], abs=1)


def test_there_are_none_where_none_were_made_or_wanted(tmp_path):
    without = workspace(tmp_path, ExportParams(formats=("glb",)))
    assert "splats" not in EXPORT.run(without)
    assert not names(without.out)


def test_nobody_who_wants_none_gets_them(tmp_path):
    context = with_splats(tmp_path, splats=())
    assert "splats" not in EXPORT.run(context)
    assert not names(context.out)


def test_damaged_splats_are_explained(tmp_path):
    context = with_splats(tmp_path)
    file = artifacts.SPLATS.load(context.inputs["splats"])
    arrays = dict(np.load(file))
    np.savez(file, **{**arrays, "centers": arrays["centers"][:10]})
    with pytest.raises(ReconstructionError, match="expected the arrays of Gaussians") as caught:
        EXPORT.run(context)
    assert "--from splats" in caught.value.hint


@pytest.mark.slow
def test_splat_transform_reads_the_ply_in_the_world_and_the_spz_in_the_frame_of_the_glb(tmp_path):
    context = with_splats(tmp_path)
    EXPORT.run(context)
    scale = np.log(WORLD.scale)
    places = {"ply": WORLD.apply(GAUSSIANS.centers), "spz": to_gltf(GAUSSIANS.centers.astype(np.float64))}
    for kind, centers in places.items():
        found = read_splats(artifacts.splats_path(context.out, kind), tmp_path)
        np.testing.assert_allclose(np.stack([found[axis] for axis in "xyz"], 1), centers, atol=2e-5)
        np.testing.assert_allclose(found["scale_0"], GAUSSIANS.log_scales[:, 0] + scale, atol=0.51 / 16)


def test_the_glb_is_in_the_frame_of_the_mesh(tmp_path):
    import trimesh

    context = with_splats(tmp_path)
    EXPORT.run(context)
    cloud = trimesh.load(artifacts.splats_path(context.out, "glb"), force="scene", process=False)
    (points,) = cloud.geometry.values()
    np.testing.assert_allclose(points.vertices, to_gltf(GAUSSIANS.centers.astype(np.float64)), atol=1e-5)
