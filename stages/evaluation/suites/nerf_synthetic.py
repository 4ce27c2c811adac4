"""NeRF-synthetic: `lego/` with `transforms_{train,val,test}.json` and `train/`, `val/`, `test/`.

The 100 photos of `train` train, the 200 of `test` are the test; alpha is the mask, and the background counts as white.
"""

from __future__ import annotations

from pathlib import Path

from stages.evaluation.suites.scene import NovelViews, SuiteScene, Wanted, folders_with, photo_names

TRAIN, TEST = "transforms_train.json", "transforms_test.json"
EXTRAS = ("_depth_", "_normal_")  # in the names of pictures that are no photos


def find_scenes(folder: Path, wanted: Wanted) -> list[SuiteScene]:
    """Scenes in `folder`, or `folder` itself if it is one."""
    return [_scene(place) for place in folders_with(folder, TRAIN, "train")]


def _scene(place: Path) -> SuiteScene:
    views: NovelViews | None = None
    lacking: tuple[str, ...] = ()
    if (place / TEST).is_file() and (place / "test").is_dir():
        names = [name for name in photo_names(place / "test") if not any(extra in name for extra in EXTRAS)]
        views = NovelViews(place / "test", tuple(names), place / TEST, background="white")
    else:
        lacking = (f"no view synthesis: {place.name} has no {TEST} with test/",)
    return SuiteScene(place.name, place / "train", place / TRAIN, views=views, lacking=lacking)
