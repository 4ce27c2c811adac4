"""The tables of docs/what-to-expect.md: a few columns of what the other benchmarks measured, in plain words.

python -m benchmarks.what_to_expect     write them anew
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from statistics import fmean

from benchmarks import hard_variants, held_out, run_sets
from benchmarks.pages import markdown_table, write_tables
from benchmarks.run_sets import GIB, RESULTS, SYNTHETIC, Result

# What stands in the photos, from what is easy to what is hard.
SCENES = {
    "city": "a city block from the air",
    "synth_helmet": "a helmet: cloth, leather, dull metal",
    "textured": "a painted jug",
    "demo": "the demo's bird: mosaic, plain and polished parts",
    "synth_spotmetal": "a cow of polished aluminium",
    "thin": "a bicycle: spokes, wire basket, leaves",
    "mirror": "a balloon dog that is a perfect mirror",
    "polished": "the demo's bird in polished aluminium",
    "synth_plaster": "a plain white part with deep holes",
    "plain": "a plain white machine part",
    "banana": "bananas on a carpet, hand-held camera",
    "viking": "a painted figurine on a turntable, black background",
}
HARD = {
    "synth_helmet": "as they are",
    "synth_helmet-no_exif": "no EXIF",
    "synth_helmet-wrong_focal": "EXIF states twice the focal length",
    "synth_helmet-two_cameras": "two cameras, mixed",
    "synth_helmet-greyscale": "black and white",
    "synth_helmet-video": "a video",
    "synth_helmet-blurred": "30 % out of focus",
    "synth_helmet-every_third": "a third of the photos",
    "synth_helmet-black_background": "black background",
    "synth_helmet-plain_ground": "no print on the ground",
    "synth_plaster": "plain white part, printed ground",
    "synth_plaster-black_background": "plain white part, black background",
    "synth_plaster-plain_ground": "plain white part, no print on the ground",
}


def quality_table(results: Sequence[Result], psnr: dict[str, float]) -> str:
    """A row a scene with a known surface or scored photos; distances are means over its seeds."""
    rows = []
    for name, words in SCENES.items():
        seeds = [result for result in results if result.name == name]
        scores = [result.score for result in seeds if result.score]
        if seeds and (scores or name in psnr):
            rows.append(
                [
                    words,
                    str(seeds[0].number("sfm", "images")),
                    *(f"{fmean(score[key] for score in scores):.{digits}f}" if scores else "-"
                      for key, digits in (("mean", 2), ("f_one_percent", 0))),
                    f"{psnr[name]:.0f}" if name in psnr else "-",
                ]
            )  # fmt: skip
    return markdown_table(["scene", "photos", "mean distance, %", "within 1 %, F-score", "new photos, PSNR dB"], rows)


def cost_table(results: Sequence[Result]) -> str:
    """A row a set, by its first seed."""
    rows = []
    for result in results:
        seconds = {stage.name: stage.wall_s for stage in result.stages}
        poses, train = (sum(seconds[stage] for stage in part) for part in (("ingest", "sfm", "undistort"), ("train",)))
        width, height = (result.number("undistort", side) for side in ("width", "height"))
        rows.append(
            [
                SCENES.get(result.name, result.name),
                f"{result.number('sfm', 'images')} of {width} x {height}",
                *(f"{part / 60:.1f}" for part in (poses, train, result.wall_s - poses - train, result.wall_s)),
                f"{result.cpu_s / 60:.1f}",
                f"{result.peak_rss / GIB:.1f}",
                f"{result.glb_bytes / 1e6:.0f}",
            ]
        )
    header = [
        "scene", "photos", "poses, min", "training, min", "the rest, min", "all, min", "CPU, min", "memory, GiB",
        "GLB, MB",
    ]  # fmt: skip
    return markdown_table(header, rows)


def hard_table(rows: Sequence[hard_variants.Row]) -> str:
    """A row a set of photos, in the order of `HARD`."""
    by_name = {row.name: row for row in rows}
    lines = [
        [
            words,
            f"{row.registered} of {row.photos}",
            f"{row.center_error['median']:.2f}" if row.center_error else "-",
            f"{row.score['mean']:.2f}" if row.score else "-",
        ]
        for words, row in ((words, by_name[name]) for name, words in HARD.items() if name in by_name)
    ]
    return markdown_table(["photos", "with a pose", "camera error, %", "mean distance, %"], lines)


def tables() -> dict[str, str]:
    """All three, from the result files."""
    sets = run_sets.load_results(RESULTS)
    psnr = {result["name"]: result["mean"]["mesh"]["object"]["psnr"] for result in held_out.load_results()}
    return {
        "expect quality": quality_table([*sets, *run_sets.load_results(RESULTS / SYNTHETIC)], psnr),
        "expect cost": cost_table([result for result in sets if result.seed == 0]),
        "expect hard": hard_table(hard_variants.load_rows()),
    }


if __name__ == "__main__":
    write_tables(tables())
    sys.exit(0)
