"""The peers that come as packages, each a program of its own, so that time and memory are theirs alone, given
NAME PHOTOS MODEL OUT.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

NEIGHBOURS = 16  # points that a normal is estimated from, and that an outlier is judged by
OUTLIER_SIGMA = 2.0
MAX_ERROR_PX = 2.0
MIN_TRACK = 3
DEPTH = 9  # of the octree, for both Poissons
# Poisson closes everything: surface with fewer points around it than this part of all has is cut away.
SPARSE_SHARE = 0.05


def sparse_cloud(model: Path) -> Any:
    """Open3D's cloud of a COLMAP model's reliable points, with normals towards the cameras that saw them."""
    import open3d as o3d
    import pycolmap

    reconstruction = pycolmap.Reconstruction(str(model))
    centers = {i: np.asarray(image.projection_center()) for i, image in reconstruction.images.items()}
    points, seen_from = [], []
    for point in reconstruction.points3D.values():
        if point.track.length() >= MIN_TRACK and point.error <= MAX_ERROR_PX:
            points.append(point.xyz)
            seen_from.append(np.mean([centers[element.image_id] for element in point.track.elements], axis=0))
    if len(points) <= NEIGHBOURS:
        sys.exit(f"only {len(points)} of {len(reconstruction.points3D)} sparse points can be relied on")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.array(points)))
    cloud, kept = cloud.remove_statistical_outlier(NEIGHBOURS, OUTLIER_SIGMA)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))
    normals = np.array(cloud.normals)
    towards = np.array(seen_from)[kept] - np.asarray(cloud.points)
    normals[(normals * towards).sum(1) < 0] *= -1
    cloud.normals = o3d.utility.Vector3dVector(normals)
    return cloud


def poisson(photos: Path, model: Path, out: Path) -> None:
    """Screened Poisson through the sparse points, by Open3D."""
    import open3d as o3d

    mesh, densities = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(sparse_cloud(model), depth=DEPTH)
    mesh.remove_vertices_by_mask(np.asarray(densities) < np.quantile(densities, SPARSE_SHARE))
    o3d.io.write_triangle_mesh(str(out), mesh)


def pymeshlab_poisson(photos: Path, model: Path, out: Path) -> None:
    """Screened Poisson through the sparse points, by pymeshlab."""
    meshes = _pymeshlab(sparse_cloud(model))
    meshes.generate_surface_reconstruction_screened_poisson(depth=DEPTH)
    meshes.save_current_mesh(str(out))


def ball_pivoting(photos: Path, model: Path, out: Path) -> None:
    """Ball pivoting of the sparse points, by pymeshlab."""
    meshes = _pymeshlab(sparse_cloud(model))
    meshes.generate_surface_reconstruction_ball_pivoting()
    meshes.save_current_mesh(str(out))


def _pymeshlab(cloud: Any) -> Any:
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(np.asarray(cloud.points), v_normals_matrix=np.asarray(cloud.normals)))
    return meshes


def colmap_dense(photos: Path, model: Path, out: Path) -> None:
    """COLMAP's patch-match stereo, fusion and Poisson; needs pycolmap with CUDA."""
    import pycolmap

    if not pycolmap.has_cuda:
        sys.exit("pycolmap has no CUDA here: `pip install pycolmap-cuda12` on a machine with an NVIDIA GPU")
    dense = out.parent / "dense"
    pycolmap.undistort_images(dense, model, photos)
    pycolmap.patch_match_stereo(dense)
    pycolmap.stereo_fusion(dense / "fused.ply", dense)
    pycolmap.poisson_meshing(dense / "fused.ply", out)


PEERS = {
    "poisson": poisson,
    "pymeshlab-poisson": pymeshlab_poisson,
    "ball-pivoting": ball_pivoting,
    "colmap-dense": colmap_dense,
}


if __name__ == "__main__":
    name, *paths = sys.argv[1:]
    PEERS[name](*map(Path, paths))
