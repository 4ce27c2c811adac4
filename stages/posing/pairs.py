"""Which pairs of photos are worth matching, told by a match of few features of each.

The largest features of a photo say which others show the same [Wu, Towards Linear-time Incremental Structure from
Motion, 3DV 2013: preemptive matching]. Matching all features of a pair takes a hundred times as long, or more. A photo
is matched with the best of its clear partners, with those next to it in name, and with a few whatever they share; pairs
that have most in common connect all photos. The best partners stand next to a photo: they tell little of depth, and of
two passes around something they are all of the same one. So some of the further clear partners are matched, too.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float, Int

PREEMPTIVE, EXHAUSTIVE = "preemptive", "exhaustive"  # matchers, as `sfm.matcher` names them
LARGEST = 300  # features of each photo that are looked at
# Photos that show nothing in common share two of these matches, and up to six; of pairs with 30 verified matches of
# all features, 99 in 100 share six.
CLEAR = 6
MOST, LEAST = 12, 4  # partners of a photo that share most: clear ones, and whatever they share
SPREAD, APART = 4, 4  # further clear partners: evenly from better to worse, and those that share least with the others
TREES = 8  # pairs, at least, by which any some photos are connected with the rest
NEXT = 2  # photos to each side in the order of names are partners, too: most captures are a walk
BEST = 3  # partners that share most are near a photo, with those next to it
AT_ONCE = 64  # photos that one is compared with in one product
# COLMAP's tests of a match, as angles between descriptors: to the nearest one, and to it over that to the second.
MAX_ANGLE, MAX_RATIO = 0.7, 0.8


def likely_pairs(database: Path) -> list[tuple[int, int]]:
    """Pairs of image ids, sorted, the first of each the smaller one."""
    ids, names, common = common_in(database)
    chosen = {*choose_pairs(common), *_next_in_name(names)}
    return [(ids[i], ids[j]) for i, j in sorted(chosen)]


def near_pairs(database: Path, left_out: Collection[str]) -> list[tuple[int, int]]:
    """Pairs among each of some photos and the few likely to show the same: the best partners, and those next in name.

    Returns:
        Pairs of image ids, sorted, the first of each the smaller one.
    """
    ids, names, common = common_in(database)
    beside = _next_in_name(names)
    pairs = set[tuple[int, int]]()
    for i, name in enumerate(names):
        if name in left_out:
            best = [int(j) for j in np.argsort(-common[i], kind="stable") if j != i][:BEST]
            group = {i, *best, *(j for pair in beside if i in pair for j in pair)}
            pairs |= set(combinations(sorted(group), 2))
    return [(ids[i], ids[j]) for i, j in sorted(pairs)]


def _next_in_name(names: Sequence[str]) -> set[tuple[int, int]]:
    """Pairs (i < j) of photos that are up to `NEXT` apart in the order of names."""
    order = sorted(range(len(names)), key=names.__getitem__)
    return {
        (min(i, j), max(i, j)) for place, i in enumerate(order) for j in order[place + 1 : place + 1 + NEXT]
    }  # fmt: skip


def common_in(database: Path) -> tuple[list[int], list[str], Int[np.ndarray, "n n"]]:
    """Ids and names of a database's images, and how many of the largest features of each two match."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.image_id)
        ids = [image.image_id for image in images]
        common = common_features([largest_descriptors(opened, image_id) for image_id in ids])
    return ids, [image.name for image in images], common


def largest_descriptors(database: Any, image_id: int) -> Float[np.ndarray, "k 128"]:
    """Descriptors of the largest features of an image of an open COLMAP database, whole numbers.

    Features that match nothing (see `stages.posing.features.append`), whose descriptors are zero, are passed over.
    """
    if not database.num_descriptors_for_image(image_id):
        return np.zeros((0, 128), np.float32)
    keypoints = database.read_keypoints(image_id)
    areas = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
    descriptors = np.asarray(database.read_descriptors(image_id).data)
    order = np.argsort(-areas, kind="stable")
    known = np.asarray(descriptors.any(axis=1))
    return descriptors[order[known[order]][:LARGEST]].astype(np.float32)


def common_features(descriptors: list[Float[np.ndarray, "_ 128"]]) -> Int[np.ndarray, "n n"]:
    """How many features of each two photos match.

    Descriptors are whole numbers up to 255, so that their products are exact, whatever the number of threads.
    """
    number = len(descriptors)
    common = np.zeros((number, number), np.int64)
    ends = np.cumsum([len(each) for each in descriptors])
    stacked = np.concatenate(descriptors) if descriptors else np.zeros((0, 128), np.float32)
    lengths = np.maximum(np.linalg.norm(stacked, axis=1), 1)
    for i, own in enumerate(descriptors):
        # of one photo and many later ones at once: many small products would lose their time between threads
        for start in range(i + 1, number, AT_ONCE):
            stop = min(start + AT_ONCE, number)
            others = slice(ends[start - 1], ends[stop - 1])
            cosines = own @ stacked[others].T
            cosines /= lengths[ends[i] - len(own) : ends[i], None]
            cosines /= lengths[others]
            for j, block in enumerate(np.split(cosines, ends[start : stop - 1] - ends[start - 1], axis=1), start):
                common[i, j] = common[j, i] = count_matches(block)
    return common


def count_matches(cosines: Float[np.ndarray, "k m"]) -> int:
    """Mutual nearest neighbours that are near, and much nearer to the first photo's feature than its second nearest.

    Args:
        cosines: of the angles between descriptors of two photos; changed.
    """
    if cosines.shape[0] == 0 or cosines.shape[1] < 2:
        return 0
    rows, nearest = np.arange(len(cosines)), cosines.argmax(1)
    mutual = cosines.argmax(0)[nearest] == rows
    best = cosines[rows, nearest]
    cosines[rows, nearest] = -1
    angle, next_angle = (np.arccos(np.clip(values, -1, 1)) for values in (best, cosines.max(1)))
    return int((mutual & (angle <= MAX_ANGLE) & (angle <= MAX_RATIO * next_angle)).sum())


def choose_pairs(common: Int[np.ndarray, "n n"]) -> list[tuple[int, int]]:
    """Pairs (i < j) to match, given how many features each two photos have in common."""
    chosen = set(_connecting(common))
    for i in range(len(common)):
        chosen |= {(min(i, j), max(i, j)) for j in _partners(common, i)}
    return sorted(chosen)


def _partners(common: Int[np.ndarray, "n n"], i: int) -> list[int]:
    """The best partners of one photo, and some of its further clear ones."""
    own = common[i]
    ranked = [int(j) for j in np.argsort(-own, kind="stable") if j != i]
    clear = [j for j in ranked if own[j] >= CLEAR]
    partners, further = ranked[: max(LEAST, min(MOST, len(clear)))], clear[MOST:]
    if further:
        partners += [further[k] for k in sorted(set(np.linspace(0, len(further) - 1, SPREAD).astype(int).tolist()))]
    for _ in range(APART):
        left = [j for j in further if j not in partners]
        if not left:
            break
        shared = common[np.ix_(left, partners)].max(axis=1, initial=0)
        partners.append(left[int(shared.argmin())])
    return partners


def _connecting(common: Int[np.ndarray, "n n"]) -> list[tuple[int, int]]:
    """Spanning trees whose pairs have most in common, one after another, each of pairs that those before left."""
    from scipy.sparse.csgraph import minimum_spanning_tree

    costs = np.triu(common.max(initial=0) + 1 - common, 1)  # above zero, which would be no edge
    found = []
    for _ in range(TREES):
        first, second = minimum_spanning_tree(costs).nonzero()
        found += [(min(i, j), max(i, j)) for i, j in zip(first.tolist(), second.tolist(), strict=True)]
        costs[first, second] = 0
    return found


# ---------------------------------------------------------------- matching
def match_pairs(database: Path, pairs: Iterable[tuple[int, int]], options: dict[str, Any]) -> None:
    """Match and verify pairs of image ids; those that are verified already are left as they are.

    Args:
        options: see `stages.posing.settings.match_options`.
    """
    import pycolmap

    listed = database.with_suffix(".pairs.txt")
    listed.write_text("".join(f"{first} {second}\n" for first, second in pairs), encoding="utf-8")
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(listed)
    with _named_by_number(database):
        pycolmap.match_image_pairs(database, pairing_options=pairing, **options)


@contextmanager
def _named_by_number(path: Path) -> Iterator[None]:
    """Images carry their ids as names for a while: COLMAP's lists of pairs take no names with spaces."""
    import pycolmap

    def rename(names: dict[int, str]) -> None:
        with pycolmap.Database.open(path) as database:
            for image_id, name in names.items():
                image = database.read_image(image_id)
                image.name = name
                database.update_image(image)

    with pycolmap.Database.open(path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
    rename({image_id: str(image_id) for image_id in names})
    try:
        yield
    finally:
        rename(names)
