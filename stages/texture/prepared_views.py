"""Photos made ready for sampling, one after the other and ahead of their use."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from stages.artifacts import AtlasMesh
from stages.artifacts.mesh import Mesh
from stages.geometry.cameras import PinholeCameras
from stages.limits import available_memory
from stages.surface.triangle_mesh import face_areas
from stages.texture.photo_views import View, prepare_view

# (photo index) -> [H, W, 3] uint8 RGB and [H, W] bool mask or None.
LoadPhoto = Callable[[int], tuple[np.ndarray, np.ndarray | None]]

# Prepared photos that stay in memory for the next pass: bytes at most, and part of what is free at most. The others are
# made again.
KEPT_BYTES, KEPT_SHARE = 1 << 30, 0.25
# Photos made ready ahead of use.
MOST_AHEAD = 8


class PreparedViews:
    """Makes photos ready for sampling, and keeps the first ones for the next pass."""

    def __init__(
        self,
        atlas: AtlasMesh,
        num_texels: int,
        cameras: PinholeCameras,
        load_photo: LoadPhoto,
        others: Mesh | None = None,
    ) -> None:
        """
        Args:
            others: what else may be in the way of photos.
        """
        self.atlas, self.cameras, self.load_photo, self.others = atlas, cameras, load_photo, others
        # mean, scene units
        self.texel_side = float(np.sqrt(face_areas(atlas.vertices, atlas.faces).sum() / num_texels))
        self.kept: dict[int, View] = {}
        self.room = min(KEPT_BYTES, int(KEPT_SHARE * available_memory()))

    def __len__(self) -> int:
        return len(self.cameras)

    def in_order(self, pool: ThreadPoolExecutor, ahead: int) -> Iterator[View]:
        """All of them, `ahead` (at most `MOST_AHEAD`) being made in the background."""
        waiting: list[Future[View]] = []
        ahead = min(ahead, MOST_AHEAD)
        submitted = 0
        for index in range(len(self)):
            while submitted < len(self) and len(waiting) <= ahead:
                waiting.append(pool.submit(self._prepare, submitted))
                submitted += 1
            view = waiting.pop(0).result()
            self._keep(index, view)
            yield view

    def _prepare(self, index: int) -> View:
        if index in self.kept:
            return self.kept[index]
        photo, mask = self.load_photo(index)
        vertices, faces = self.atlas.vertices, self.atlas.faces
        return prepare_view(self.cameras, index, photo, mask, vertices, faces, self.texel_side, self.others)

    def _keep(self, index: int, view: View) -> None:
        """Keep a photo where there is room. Not for threads: they would take one another's."""
        if index not in self.kept and view.nbytes <= self.room:
            self.room -= view.nbytes
            self.kept[index] = view
