"""What became of each photo: features, matches, and why it has no pose."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

MIN_VERIFIED = 15  # matches that fit one epipolar geometry before COLMAP believes a pair (its default)
MIN_PNP = 30  # 3D points a photo must agree with to be placed (COLMAP's default)
MIN_FEATURES = 50  # below this a photo shows too little texture to match anything


class Evidence:
    """What the database says of each photo: features, and verified matches with every other."""

    def __init__(self, database_path: Path) -> None:
        import pycolmap

        with pycolmap.Database.open(database_path) as database:
            images = {image.image_id: image.name for image in database.read_all_images()}
            self.features = {name: database.num_keypoints_for_image(i) for i, name in images.items()}
            pair_ids, inliers = database.read_two_view_geometry_num_inliers()
        self.pairs: dict[str, dict[str, int]] = {name: {} for name in images.values()}
        for pair_id, count in zip(pair_ids, inliers, strict=True):
            first, second = (images[i] for i in pycolmap.pair_id_to_image_pair(pair_id))
            if count:
                self.pairs[first][second] = self.pairs[second][first] = int(count)

    @property
    def best_pair(self) -> int:
        """Verified matches of the best pair of photos."""
        return max((count for pairs in self.pairs.values() for count in pairs.values()), default=0)

    def reason(
        self,
        name: str,
        registered: Iterable[str],
        others: Iterable[Iterable[str]],
        verified: int = MIN_VERIFIED,
        agreeing: int = MIN_PNP,
    ) -> str:
        """Why the photo `name` is not in the model, in words.

        Args:
            registered, others: photos of the model, and of each other one.
            verified, agreeing: matches of a pair and points of a photo that were enough in the last attempt.
        """
        registered = set(registered)
        features = self.features.get(name, 0)
        if features < MIN_FEATURES:
            return f"too few features: {features} found, about {MIN_FEATURES} needed (blurred, dark or plain)"
        for other in map(set, others):
            if name in other:
                return f"in another component of {len(other)} photos that does not connect to this one"
        pairs = self.pairs.get(name, {})
        best = max(pairs.values(), default=0)
        if best < verified:
            return f"matches no other photo: best pair has {best} verified matches, need {verified}"
        linked = [count for other, count in pairs.items() if other in registered]
        if not linked:
            return f"matches only photos that are left out too (best pair: {best} verified matches)"
        return (
            f"could not be placed: {len(linked)} registered photos match it (best pair: {max(linked)} "
            f"verified matches), but fewer than {agreeing} of its 3D points agreed on one position"
        )
