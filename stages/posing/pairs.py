"""Which pairs of photos are worth matching, told by a match of few features of each.

The largest features of a photo say which others show the same [Wu, Towards Linear-time Incremental Structure from
Motion, 3DV 2013: preemptive matching]. Matching all features of a pair takes a hundred times as long, or more. A photo
is matched with the best of its clear partners, with those next to it in name, and with a few whatever they share; pairs
that have most in common connect all photos. The best partners stand next to a photo: they tell little of depth, and of
two passes around something they are all of the same one. So some of the further clear partners are matched, too.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float, Int, Num, UInt8

log = logging.getLogger(__name__)

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
NOT_COMPARED = -1
# Where not all pairs are compared, so many times those are, too, that share a partner among the best of both.
GROWTHS, THIRD_PARTIES = 2, 10
# COLMAP's tests of a match, as angles between descriptors: to the nearest one, and to it over that to the second.
MAX_ANGLE, MAX_RATIO = 0.7, 0.8


def likely_pairs(database: Path, among: Collection[tuple[int, int]] | None = None) -> list[tuple[int, int]]:
    """Pairs of image ids, sorted, the first of each the smaller one.

    Args:
        among: the pairs that are compared; all without.
    """
    ids, names, common = common_in(database, among)
    chosen = {*choose_pairs(common), *_next_in_name(names)}
    log.info("%d pairs are matched, %.1f a photo, of %d", len(chosen), 2 * len(chosen) / max(len(ids), 1),
             len(among) if among is not None else len(ids) * (len(ids) - 1) // 2)  # fmt: skip
    return [(ids[i], ids[j]) for i, j in sorted(chosen)]


def near_pairs(
    database: Path, left_out: Collection[str], among: Collection[tuple[int, int]] | None = None
) -> list[tuple[int, int]]:
    """Pairs among each of some photos and the few likely to show the same: the best partners, and those next in name.

    Args:
        among: the pairs that are compared; all without.

    Returns:
        Pairs of image ids, sorted, the first of each the smaller one.
    """
    ids, names, common = common_in(database, among)
    beside = _next_in_name(names)
    pairs = set[tuple[int, int]]()
    for i, name in enumerate(names):
        if name in left_out:
            best = [int(j) for j in np.argsort(-common[i], kind="stable") if j != i and common[i, j] >= 0][:BEST]
            group = {i, *best, *(j for pair in beside if i in pair for j in pair)}
            pairs |= set(combinations(sorted(group), 2))
    return [(ids[i], ids[j]) for i, j in sorted(pairs)]


def _next_in_name(names: Sequence[str]) -> set[tuple[int, int]]:
    """Pairs (i < j) of photos that are up to `NEXT` apart in the order of names."""
    order = sorted(range(len(names)), key=names.__getitem__)
    return {
        (min(i, j), max(i, j)) for place, i in enumerate(order) for j in order[place + 1 : place + 1 + NEXT]
    }  # fmt: skip


def in_order(first: int, second: int) -> tuple[int, int]:
    """A pair, the smaller one first."""
    return min(first, second), max(first, second)


def common_in(
    database: Path, among: Collection[tuple[int, int]] | None = None
) -> tuple[list[int], list[str], Int[np.ndarray, "n n"]]:
    """Ids and names of a database's images, and how many of the largest features of each two match.

    Args:
        among: pairs of image ids that are compared, with partners of partners; all without.
    """
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.image_id)
        ids = [image.image_id for image in images]
        descriptors = [largest_descriptors(opened, image_id, LARGEST) for image_id in ids]
    places = {image_id: place for place, image_id in enumerate(ids)}
    if among is None:
        return ids, [image.name for image in images], common_features(descriptors)
    common = common_features(descriptors, [in_order(places[i], places[j]) for i, j in among])
    for _ in range(GROWTHS):
        further = common_features(descriptors, partners_of_partners(common))
        common = np.maximum(common, further)
    return ids, [image.name for image in images], common


def partners_of_partners(common: Int[np.ndarray, "n n"]) -> list[tuple[int, int]]:
    """Pairs (i < j) not compared so far of photos that both share much with a third one.

    Args:
        common: how many features each two photos have in common, see `common_features`.
    """
    best = np.argsort(-common, axis=1, kind="stable")[:, :THIRD_PARTIES]
    clear = [[j for j in row if common[i, j] >= CLEAR] for i, row in enumerate(best.tolist())]
    both = {in_order(i, k) for i, own in enumerate(clear) for j in own for k in clear[j] if k != i}
    return sorted((i, k) for i, k in both if common[i, k] == NOT_COMPARED)


def largest_descriptors(database: Any, image_id: int, count: int) -> UInt8[np.ndarray, "k 128"]:
    """Descriptors of the largest features of an image of an open COLMAP database, whole numbers.

    Features that match nothing (see `stages.posing.features.append`), whose descriptors are zero, are passed over.
    """
    if not database.num_descriptors_for_image(image_id):
        return np.zeros((0, 128), np.uint8)
    keypoints = database.read_keypoints(image_id)
    areas = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
    descriptors = np.asarray(database.read_descriptors(image_id).data)
    order = np.argsort(-areas, kind="stable")
    known = np.asarray(descriptors.any(axis=1))
    return descriptors[order[known[order]][:count]]


def common_features(
    descriptors: Sequence[Num[np.ndarray, "_ 128"]], among: Iterable[tuple[int, int]] | None = None
) -> Int[np.ndarray, "n n"]:
    """How many features of each two photos match; `NOT_COMPARED` where that was not looked at.

    Descriptors are whole numbers up to 255, so that their products are exact, whatever the number of threads.

    Args:
        among: pairs (i < j) of photos that are compared; all without.
    """
    number = len(descriptors)
    partners: list[list[int]] = [list(range(i + 1, number)) if among is None else [] for i in range(number)]
    for i, j in sorted(among or ()):
        partners[i].append(j)
    common = np.full((number, number), 0 if among is None else NOT_COMPARED, np.int32)
    np.fill_diagonal(common, 0)
    lengths = [np.maximum(np.linalg.norm(each.astype(np.float32), axis=1), 1) for each in descriptors]
    for i, later in enumerate(partners):
        own = descriptors[i].astype(np.float32)
        # of one photo and many later ones at once: many small products would lose their time between threads
        for start in range(0, len(later), AT_ONCE):
            some = later[start : start + AT_ONCE]
            cosines = own @ np.concatenate([descriptors[j] for j in some]).astype(np.float32).T
            cosines /= lengths[i][:, None]
            cosines /= np.concatenate([lengths[j] for j in some])
            ends = np.cumsum([len(descriptors[j]) for j in some])
            for j, block in zip(some, np.split(cosines, ends[:-1], axis=1), strict=True):
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
        chosen |= {in_order(i, j) for j in _partners(common, i)}
    return sorted(chosen)


def _partners(common: Int[np.ndarray, "n n"], i: int) -> list[int]:
    """The best partners of one photo, and some of its further clear ones."""
    own = common[i]
    ranked = [int(j) for j in np.argsort(-own, kind="stable") if j != i and own[j] != NOT_COMPARED]
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
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import minimum_spanning_tree

    first, second = np.nonzero(np.triu(common != NOT_COMPARED, 1))
    weights = common.max(initial=0) + 1 - common[first, second]  # above zero, which would be no edge
    costs = csr_array((weights, (first, second)), shape=common.shape)
    found = []
    for _ in range(TREES):
        tree = minimum_spanning_tree(costs)
        found += [in_order(i, j) for i, j in zip(*(ends.tolist() for ends in tree.nonzero()), strict=True)]
        costs = costs - csr_array(tree)
        costs.eliminate_zeros()
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
