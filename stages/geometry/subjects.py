"""Which photos are about one thing: a capture may hold two things far apart, of which one region can hold one.

Photos that see the same points of what they are about (`attention`) are about the same. Whether two things are one
subject is a matter of distance: two statues at a gate are, one in the garden and one in the hall are not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from stages.geometry.attention import MIN_LOOKING, attended
from stages.geometry.cameras import PinholeCameras
from stages.geometry.region import Sphere, enclosing_sphere, merged_spheres, without_strays

if TYPE_CHECKING:
    from jaxtyping import Float, Int, Integer

# Two photos are about the same thing if they share this many points of it.
MIN_SHARED = 8
# Things are far apart if the sphere about both is this many times as large as that about the larger one: 2 where
# like spheres touch, 3 where they are their own diameter apart, 5.6 for two things 15 diameters apart on one floor.
FAR_APART = 4.0


class Subject(NamedTuple):
    """Something that photos are about.

    Attributes:
        photos: indices of those.
        sphere: centre and radius about what they look at, the ground near it included.
    """

    photos: Int[np.ndarray, " k"]
    sphere: Sphere


def find_subjects(
    cameras: PinholeCameras, points: Float[np.ndarray, "p 3"], observations: Integer[np.ndarray, "m 2"]
) -> list[Subject]:
    """What lies so far apart that no region should hold two of it; that of most photos first.

    A few photos of something else (fewer than it takes to attend to a point) are no subject, and in none.

    Args:
        observations: rows (image index, point index).
    """
    about = attended(cameras, points, observations)
    seen = observations[about[observations[:, 1]]]
    subjects: list[Subject] = []
    for photos in _sharing(seen, len(cameras), len(points)):
        places = without_strays(points[np.unique(seen[np.isin(seen[:, 0], photos), 1])])
        if len(photos) >= MIN_LOOKING and len(places):
            subjects = _joined(subjects, Subject(photos, enclosing_sphere(places)))
    return sorted(subjects, key=lambda subject: -len(subject.photos))


def _sharing(seen: Integer[np.ndarray, "m 2"], photos: int, points: int) -> list[Int[np.ndarray, " k"]]:
    """Groups of photos that hang together by the points they share."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    sees = coo_matrix((np.ones(len(seen)), (seen[:, 0], seen[:, 1])), shape=(photos, points)).tocsr()
    count, group = connected_components((sees @ sees.T) >= MIN_SHARED, directed=False)
    return [np.flatnonzero(group == k) for k in range(count)]


def _joined(subjects: list[Subject], new: Subject) -> list[Subject]:
    """The subjects with one more, which takes in all that are not far from it."""
    for other in subjects:
        both = merged_spheres(new.sphere, other.sphere)
        if both[1] <= FAR_APART * max(new.sphere[1], other.sphere[1]):
            rest = [subject for subject in subjects if subject is not other]
            return _joined(rest, Subject(np.union1d(new.photos, other.photos), both))
    return [*subjects, new]


def seen_by(
    photos: Integer[np.ndarray, " k"], points: Float[np.ndarray, "p 3"], observations: Integer[np.ndarray, "m 2"]
) -> tuple[Float[np.ndarray, "q 3"], Integer[np.ndarray, "l 2"]]:
    """The points that some of the photos see, and their observations, both numbered anew."""
    rows = observations[np.isin(observations[:, 0], photos)]
    kept, index = np.unique(rows[:, 1], return_inverse=True)
    renumbered = np.stack([np.searchsorted(photos, rows[:, 0]), index.reshape(-1)], axis=1)
    return points[kept], renumbered.astype(observations.dtype)
