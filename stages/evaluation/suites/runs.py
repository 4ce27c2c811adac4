"""`hineus bench`: run a suite's scenes, each in a workspace of its own, score them, and keep one JSON a run.

OUT/SUITE/SCENE/PRESET-seed0/         the workspace; the engine resumes it
OUT/SUITE/SCENE/PRESET-seed0.json     settings, seed, machine, time, memory, scores
OUT/SUITE/SCENE/PRESET-seed0.ply      the mesh that was scored, in the frame of the poses
OUT/SUITE/SCENE/PRESET-4-blocks-seed0/  and so on: of a run in four blocks
OUT/SUITE/SCENE/peers/                what peers started from, and a folder each
OUT/SUITE/SCENE/PRESET-peer-NAME.json
"""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from glob import escape
from pathlib import Path
from typing import Any, Literal

from configs.dotted import flatten
from configs.params import Config
from stages import artifacts
from stages.block_by_block import reconstruct_in_blocks
from stages.engine.runner import Listener, StageOutcome
from stages.engine.stage import Stage
from stages.engine.workspace import Workspace, storage_errors
from stages.errors import ConfigError, HineusError, InputError
from stages.evaluation.machine import machine
from stages.evaluation.peers.running import MESH, Peer, run_peer
from stages.evaluation.suites.registry import Suite, find_scenes
from stages.evaluation.suites.scene import SuiteScene, Wanted
from stages.evaluation.suites.scores import Part, posed_mesh, result_mesh, score_result
from stages.export_poses import export_poses
from stages.geometry.similarity import Similarity
from stages.inputs.folders import WORKSPACE_RECORD, is_workspace
from stages.posing.exporting import write_colmap
from stages.reconstruct import Reconstruction, default_preset, reconstruct
from stages.request import Request

log = logging.getLogger(__name__)

# Raised whenever the same results would get other scores: what was scored before is scored anew.
SCORING = 1
POSED = ("ingest", "sfm", "place", "undistort")  # what peers are given, too
SHARED = (*POSED, "densify")  # stages that no seed changes
OURS = "hineus"


@dataclass(frozen=True)
class BenchRequest:
    """What the user asked for.

    Attributes:
        suite, data: which scenes, and where they lie. out: where results go.
        scenes: names; none: all.
        seeds: how many runs a scene, with seeds 0, 1, ...
        wanted: how scenes are read. peers: run on the same photos and poses.
        preset, sets, until, device, workers: see `Request`.
        blocks: how many each scene is cut into, or "auto"; None: it is run in one.
    """

    suite: Suite
    data: Path
    out: Path
    scenes: Sequence[str] = ()
    seeds: int = 1
    wanted: Wanted = field(default_factory=Wanted)
    peers: Sequence[Peer] = ()
    preset: str | None = None
    sets: Sequence[str] = ()
    until: str | None = None
    device: str = "auto"
    workers: int | None = None
    blocks: int | Literal["auto"] | None = None

    @property
    def run_name(self) -> str:
        """Of the files of a run, but for its seed."""
        cut = "" if self.blocks is None else "-in-blocks" if self.blocks == "auto" else f"-{self.blocks}-blocks"
        return f"{self.preset}{cut}"


def run_bench(
    request: BenchRequest, pipeline: Sequence[Stage], listener: Listener | None = None
) -> Iterator[dict[str, Any]]:
    """Run scene after scene; what is fresh is not run again. A scene that fails does not stop the others.

    Yields:
        A result for each run and peer, JSON-able, as it is kept; where something failed, with its "error".

    Raises:
        HineusError: the scenes cannot be found, or the settings are wrong.
    """
    scenes = find_scenes(request.suite, request.data, request.wanted, request.scenes)
    if request.out.resolve() == request.data.resolve():
        raise InputError("Results would lie among the data.", "Name another folder with `--out`.")
    if request.peers and request.blocks is not None:
        raise ConfigError("`--peer` does not go with `--blocks`.", "Peers are run on scenes in one.")
    request = replace(request, preset=request.preset or default_preset())
    for scene in scenes:
        folder = request.out / request.suite.name / scene.name
        for sentence in scene.lacking:
            log.warning("%s: %s", scene.name, sentence)
        for seed in range(request.seeds):
            log.info("%s %s, seed %d", request.suite.title, scene.name, seed)
            yield _run(request, pipeline, listener, scene, folder, seed)
        yield from _run_peers(request, scene, folder)


# ---------------------------------------------------------------- ours
def _run(
    request: BenchRequest,
    pipeline: Sequence[Stage],
    listener: Listener | None,
    scene: SuiteScene,
    folder: Path,
    seed: int,
) -> dict[str, Any]:
    place = folder / f"{request.run_name}-seed{seed}"
    file = place.with_name(f"{place.name}.json")
    result = {**_heading(request, scene, OURS), "seed": seed}
    try:
        if seed:
            _share_poses(folder / f"{request.run_name}-seed0", place)
        done = _reconstruct(request, _ask(request, scene, place, seed), pipeline, listener)
        made_from = {"scoring": SCORING, **done.made_from}
        known = _load(file)
        if known and _is_current(known, made_from, result):
            return known
        result |= _costs(done)
        result["settings"] = _differing(done.whole.config.model_dump(mode="json"))
        mesh = result_mesh(done.parts, done.fresh, place.with_name(f"{place.name}.ply"))
        workspace, device = done.whole.workspace, done.whole.device
        result["scores"] = score_result(scene, workspace, done.parts, mesh, done.fresh, device)
        result["made_from"] = made_from
    except HineusError as error:
        return _failed(result, error)
    _save(file, result)
    return result


def _ask(request: BenchRequest, scene: SuiteScene, place: Path, seed: int) -> Request:
    """The run of one scene; test photos are kept from every stage, and the protocols see nothing off the masks."""
    left_out = json.dumps([escape(name) for name in scene.left_out])
    sets = [
        *(["undistort.masks=alone"] if scene.masks is not None else []),
        *request.sets,
        f"train.seed={seed}",
        *([f"ingest.leave_out={left_out}"] if scene.left_out else []),
    ]
    return Request(
        photos=scene.photos,
        workspace=place,
        masks=scene.masks,
        no_masks=scene.masks is None,
        poses=scene.poses,
        no_poses=scene.poses is None,
        preset=request.preset,
        sets=sets,
        until=request.until,
        device=request.device,
        workers=request.workers,
    )


def _share_poses(first: Path, place: Path) -> None:
    """Start another seed from the poses and dense points of the first: only the training is to differ."""
    if place.exists() or not is_workspace(first):
        return
    partial = place.with_name(f"{place.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        with storage_errors(place, "copying the poses"):
            for name in SHARED:
                if (first / name).is_dir():
                    shutil.copytree(first / name, partial / name)
            for name in (WORKSPACE_RECORD, "config.yaml"):
                shutil.copyfile(first / name, partial / name)
            partial.rename(place)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@dataclass(frozen=True)
class _Done:
    """A run, in one or in blocks.

    Attributes:
        parts: where its results are. fresh: stages that are up to date in all of them.
        outcomes: of all stages, those of each block as well.
        photos: how many have poses; None: not so far yet.
        made_from: fingerprints of what is there.
    """

    whole: Reconstruction
    parts: tuple[Part, ...]
    fresh: set[str]
    outcomes: tuple[StageOutcome, ...]
    photos: int | None
    made_from: dict[str, str]


def _reconstruct(request: BenchRequest, asked: Request, pipeline: Sequence[Stage], listener: Listener | None) -> _Done:
    """Raises HineusError: the run, or one of its blocks, failed."""
    if request.blocks is None:
        whole = reconstruct(asked, pipeline, listener)
        fresh = {outcome.name for outcome in whole.outcomes}
        photos = next((int(o.numbers["images"]) for o in whole.outcomes if o.name == "undistort"), None)
        itself = Part(whole.workspace, Similarity.identity())
        return _Done(whole, (itself,), fresh, whole.outcomes, photos, _fingerprints(whole.workspace, fresh))
    runs = reconstruct_in_blocks(asked, None if request.blocks == "auto" else request.blocks, pipeline, listener)
    if failure := runs.failure():
        raise failure
    poses_from_plan = runs.plan.plan_from_poses.similarity().inverse()
    parts = tuple(Part(Workspace.open(outcome.workspace), poses_from_plan) for outcome in runs.outcomes)
    names, outcomes, made_from = [stage.name for stage in pipeline], [*runs.whole.outcomes], dict[str, str]()
    for part in parts:
        made = _fingerprints(part.workspace, names)
        made_from |= {f"{part.workspace.root.name} {name}": fingerprint for name, fingerprint in made.items()}
        outcomes += [
            StageOutcome.of(manifest, "skipped", "") for name in names if (manifest := part.workspace.published(name))
        ]
    photos = len({photo for block in runs.plan.blocks for photo in block.photos})
    return _Done(runs.whole, parts, set(names), tuple(outcomes), photos, made_from)


def _costs(done: _Done) -> dict[str, Any]:
    stages = [
        {
            "name": outcome.name,
            "wall_s": round(outcome.wall_s, 2),
            "cpu_s": round(outcome.cpu_s, 2),
            "peak_rss": outcome.peak_rss,
        }
        for outcome in done.outcomes
    ]
    return {
        "device": done.whole.device,
        "machine": machine(),
        "wall_s": round(sum(outcome.wall_s for outcome in done.outcomes), 2),
        "cpu_s": round(sum(outcome.cpu_s for outcome in done.outcomes), 2),
        # what peers are to be compared with: they start from photos that have poses
        "wall_after_poses_s": round(sum(o.wall_s for o in done.outcomes if o.name not in POSED), 2),
        "peak_rss": max(outcome.peak_rss for outcome in done.outcomes),
        "photos": done.photos,
        "stages": stages,
    }


def _differing(settings: dict[str, Any]) -> dict[str, Any]:
    """The settings that are not the defaults; they are all that a run is made again from."""
    defaults = flatten(Config().model_dump(mode="json"))
    return {key: value for key, value in flatten(settings).items() if value != defaults[key]}


def _fingerprints(workspace: Workspace, stages: Iterable[str]) -> dict[str, str]:
    manifests = {name: workspace.published(name) for name in sorted(stages)}
    return {name: manifest.identity.fingerprint for name, manifest in manifests.items() if manifest}


# ---------------------------------------------------------------- peers
def _run_peers(request: BenchRequest, scene: SuiteScene, folder: Path) -> Iterator[dict[str, Any]]:
    """The peers on the photos and poses of the first seed, which are written out once."""
    given = folder / "peers" / f"{request.preset}-photos"
    shutil.rmtree(given, ignore_errors=True)  # those of an earlier call may be of other poses
    for peer in request.peers:
        log.info("%s %s, peer %s", request.suite.title, scene.name, peer.name)
        result = _heading(request, scene, peer.name)
        file = folder / f"{request.preset}-peer-{peer.name}.json"
        made = folder / "peers" / f"{request.preset}-{peer.name}"
        try:
            workspace = Workspace.open(folder / f"{request.preset}-seed0")
            made_from = {"scoring": SCORING, "command": list(peer.given), **_fingerprints(workspace, POSED)}
            known = _load(file)
            if known and _is_current(known, made_from, result):
                yield known
                continue
            if not given.exists():
                export_poses(workspace.root, given, write_colmap)
            result |= run_peer(peer, given, made)
            mesh = posed_mesh(workspace, made / MESH, file.with_suffix(".ply"))
            result["scores"] = score_result(scene, workspace, (), mesh, set(), "cpu")
            result["made_from"] = made_from
        except HineusError as error:
            yield _failed(result, error)
            continue
        _save(file, result)
        yield result


# ---------------------------------------------------------------- results
def _heading(request: BenchRequest, scene: SuiteScene, method: str) -> dict[str, Any]:
    cut = () if request.blocks is None else (f"blocks={request.blocks}",)
    return {
        "suite": request.suite.name,
        "scene": scene.name,
        "method": method,
        "preset": request.preset,
        "asked": dict(text.partition("=")[::2] for text in (*request.sets, *cut)) if method == OURS else {},
        "masks": scene.masks is not None,
        "known_poses": scene.poses is not None,
        "lacking": list(scene.lacking),
    }


def _is_current(known: dict[str, Any], made_from: dict[str, Any], heading: dict[str, Any]) -> bool:
    """Whether a result that was kept is of the same run, and all that can be scored now was scored then."""
    return known.get("made_from") == made_from and known.get("lacking") == heading["lacking"]


def _failed(result: dict[str, Any], error: HineusError) -> dict[str, Any]:
    log.error("%s, %s: %s %s", result["scene"], result["method"], error.message, error.hint)
    told = {"type": type(error).__name__, "message": error.message, "hint": error.hint, "exit_code": error.exit_code}
    return {**result, "error": told}


def _save(file: Path, result: dict[str, Any]) -> None:
    with storage_errors(file.parent, "keeping the result"):
        artifacts.write_json(file, result)


def _load(file: Path) -> dict[str, Any] | None:
    """A result that was kept; one that cannot be read is made again."""
    try:
        return dict(artifacts.read_json(file))
    except (OSError, ValueError):
        return None


def load_results(out: Path) -> list[dict[str, Any]]:
    """All results kept under `out`, by suite, scene and file name."""
    found = (_load(path) for path in sorted(out.glob("*/*/*.json")))
    return [result for result in found if result and "suite" in result]
