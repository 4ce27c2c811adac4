"""How well each vertex of a textured mesh is known: seen by how many photos, how squarely, in how much detail, how
far their colours disagree, and how much of the texture around it no photo saw.

Shapes: V vertices, N photos.
"""

from __future__ import annotations

import numpy as np

from stages.artifacts import AtlasMesh, VertexQuality
from stages.compiling import njit
from stages.drawing.rasterizing import Texels
from stages.surface.triangle_mesh import face_areas, sum_around
from stages.texture.baking import Provenance
from stages.texture.observing import sample_points
from stages.texture.photo_views import View

# Keeps the colour covariance invertible where photos are nearly grey: one 8-bit level, squared.
_COLOR_VARIANCE_FLOOR = 1.0


class VertexWitness:
    """What photos, shown one by one, say of each vertex, with the visibility of the texture itself.

    Args:
        atlas: the final mesh, scene frame.
        num_photos: N.
    """

    def __init__(self, atlas: AtlasMesh, num_photos: int) -> None:
        count = len(atlas.vertices)
        self.atlas = atlas
        self.seen = np.zeros((num_photos, count), dtype=np.bool_)
        self.colors = np.zeros((num_photos, count, 3), dtype=np.uint8)
        self.facing = np.zeros(count, dtype=np.float32)
        self.photo_density = np.zeros(count, dtype=np.float32)
        self.moments = np.zeros((4, 4))  # of (1, r, g, b)
        self._weights, self._sampled = np.zeros(count, dtype=np.float32), np.zeros((count, 3), dtype=np.float32)

    def look(self, index: int, view: View, gains: np.ndarray) -> None:
        """Take photo `index` into account; `gains` [3] make it agree with the others."""
        vertices, normals = self.atlas.vertices, self.atlas.normals
        sample_points(
            vertices, normals, view.matrix, view.center, view.focal,
            view.inverse_depth, view.confidence, view.original, self._weights, self._sampled,
        )  # fmt: skip
        hit = np.flatnonzero(self._weights > 0)
        self.seen[index, hit] = True
        even = np.clip(self._sampled[hit] * gains, 0, 255)
        self.colors[index, hit] = np.round(even)
        ones = np.concatenate([np.ones((len(even), 1)), even], 1)
        self.moments += ones.T @ ones
        to_camera = view.center - vertices[hit]
        cos = (normals[hit] * to_camera).sum(1) / np.linalg.norm(to_camera, axis=1)
        depth = vertices[hit] @ view.matrix[2, :3] + view.matrix[2, 3]
        self.facing[hit] = np.maximum(self.facing[hit], cos)
        self.photo_density[hit] = np.maximum(self.photo_density[hit], view.focal * cos / depth)

    def quality(self, texels: Texels, provenance: np.ndarray) -> VertexQuality:
        """Measures of each vertex over the photos that were shown.

        Args:
            texels: the atlas rasterised, see `rasterizing.rasterize_atlas`.
            provenance: [S, S] uint8 of `baking.Provenance`.
        """
        return VertexQuality(
            seen_by=self.seen.sum(0).astype(np.uint16),
            facing=self.facing,
            ambiguity=mean_disagreement(self.colors, self.seen, color_precision(self.moments)),
            photo_density=self.photo_density,
            texel_density=texel_density(self.atlas),
            invented=invented_share(self.atlas, texels, provenance),
        )


def color_precision(moments: np.ndarray) -> np.ndarray:
    """Inverse [3, 3] of the colours' covariance from their moments, the sum [4, 4] of (1, r, g, b)^T (1, r, g, b).

    The paper's Sigma^-1 (eq. ambiguity_factor), over what the photos show of the mesh. Each channel's variance gets a
    floor of one 8-bit level.
    """
    mean = moments[0, 1:] / max(moments[0, 0], 1)
    covariance = moments[1:, 1:] / max(moments[0, 0], 1) - np.outer(mean, mean)
    return np.linalg.inv(covariance + _COLOR_VARIANCE_FLOOR * np.eye(3))


def mean_disagreement(colors: np.ndarray, seen: np.ndarray, precision: np.ndarray) -> np.ndarray:
    """The paper's ambiguity lambda [V] float32 on the final mesh, averaged over the photos that see a vertex.

    lambda_i = mean over the other photos j that see it of D_M(C_i, C_j), the Mahalanobis distance of their colours (eq.
    ambiguity_factor with V_j 0 or 1). The mean over i is that over pairs. 0 where fewer than two photos see it.

    Args:
        colors: [N, V, 3] uint8.
        seen: [N, V] bool.
        precision: [3, 3] inverse colour covariance.
    """
    whitening = np.linalg.cholesky(precision).astype(np.float32)  # distances of c @ whitening are D_M
    result = np.zeros(seen.shape[1], dtype=np.float32)
    _mean_of_pairs(np.ascontiguousarray(colors), seen, whitening, result)
    return result


@njit(nogil=True, cache=True)
def _mean_of_pairs(colors, seen, whitening, result):  # pragma: no cover - compiled
    num_photos, count = seen.shape
    white = np.empty((num_photos, 3), dtype=np.float32)
    for v in range(count):
        used = 0
        for i in range(num_photos):
            if seen[i, v]:
                for c in range(3):
                    white[used, c] = (
                        colors[i, v, 0] * whitening[0, c]
                        + colors[i, v, 1] * whitening[1, c]
                        + colors[i, v, 2] * whitening[2, c]
                    )
                used += 1
        total = 0.0
        for i in range(used):
            for j in range(i):
                dx, dy, dz = white[i, 0] - white[j, 0], white[i, 1] - white[j, 1], white[i, 2] - white[j, 2]
                total += np.sqrt(dx * dx + dy * dy + dz * dz)
        if used > 1:
            result[v] = 2 * total / (used * (used - 1))


def texel_density(atlas: AtlasMesh) -> np.ndarray:
    """Texels per scene unit [V] float32: root of the texels of the faces around a vertex over their area."""
    areas = face_areas(atlas.vertices, atlas.faces)
    texels = face_areas(np.pad(atlas.uvs, ((0, 0), (0, 1))), atlas.faces) * atlas.texture_size**2
    texels, areas = sum_around(atlas.faces, np.stack([texels, areas], 1), len(atlas.vertices)).T
    return np.sqrt(texels / np.maximum(areas, 1e-20)).astype(np.float32)


def invented_share(atlas: AtlasMesh, texels: Texels, provenance: np.ndarray) -> np.ndarray:
    """Part of the texels of the faces around a vertex [V] float32 that no photo saw; 0 where they have no texel."""
    invented = texels.face_ids[provenance.ravel()[texels.index] == Provenance.FIELD]
    counts = [np.bincount(ids, minlength=len(atlas.faces)) for ids in (invented, texels.face_ids)]
    made_up, all_of_them = sum_around(atlas.faces, np.stack(counts, 1), len(atlas.vertices)).T
    return (made_up / np.maximum(all_of_them, 1)).astype(np.float32)
