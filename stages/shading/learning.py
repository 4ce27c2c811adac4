"""Materials of points, and the light on them unless it is given, from what photos say: the loop over `fitting`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from stages.light.environment import solid_angles
from stages.light.ggx import ROUGHNESSES
from stages.shading.exposures import balanced, exposures
from stages.shading.few_materials import choose_few, few_colors, heard, neighbors, of_one_kind
from stages.shading.fitting import (
    BRIGHTEST,
    LEVELS,
    Materials,
    Part,
    decoded,
    find_light,
    grey_world,
    radiance_of,
    try_out,
)
from stages.shading.given_light import GivenLight, Placed
from stages.shading.observations import Observations
from stages.shading.reflection import LIGHT_ROWS, Reflection

# From each start so many turns; the better one goes on for so many more.
FIRST_TURNS, MORE_TURNS = 4, 5
# Metal beside what is none must lower the cost by this part, of the whole thing and of each of its paints: what is in
# shade, mirrors the thing itself or has a normal a little off fits the other kind a little better, and the light
# follows (4 % on rough copper, 35 % on a thing of paint and metals).
BOTH_WORTH = 0.1
# Points that take part in the turns, and in finding the light.
MOST_POINTS, LIGHT_POINTS = 3000, 2000
# Where all is metal nothing tells how bright light and surface are; a metal's brightest channel is then about this.
METAL = 0.65
# Else mirrored light tells, not well: the brightest twentieth of a thing is not brighter than white paint.
WHITE = 0.8
# A roughness is told where the next but one fits worse by this part.
TOLD_MARGIN = 0.02


@dataclass(frozen=True)
class Material:
    """One of the few that the thing is made of.

    Attributes:
        metallic: 0 or 1.
        level: of `ggx.ROUGHNESSES`, the best one.
        roughness: between them.
        told: whether the photos tell the roughness.
    """

    metallic: int
    level: int
    roughness: float
    told: bool


@dataclass(frozen=True)
class Learned:
    """What is known in the end.

    Attributes:
        light: [LIGHT_ROWS, 2 LIGHT_ROWS, 3] float32 in units of the photos' full scale.
        materials: the few.
        which: [S] the material of each point.
        color: [S, 3] float32 linear base colours.
        gains: [N] factor on each photo's linear values.
        cost: of the fit, see `fitting.robust`.
        placed: how the light that was given lies; None where none was.
    """

    light: np.ndarray
    materials: tuple[Material, ...]
    which: np.ndarray
    color: np.ndarray
    gains: np.ndarray
    cost: float
    placed: Placed | None = None


@dataclass(frozen=True)
class _Choice:
    """Of the candidates of `fitting.try_out`, 2 R of them.

    Attributes:
        chosen: the few.
        which: [S] a place among them for each point.
        best: [S] the candidate of each.
        color: [S, 3] the base colour of each with it.
        shared: [S, 2 R] costs of all, heard among neighbours.
        cost: mean cost of the best.
    """

    chosen: list[int]
    which: np.ndarray
    best: Tensor
    color: Tensor
    shared: np.ndarray
    cost: float


@dataclass(frozen=True)
class _State:
    light: Tensor
    materials: Materials
    gains: Tensor
    kinds: tuple[int, ...] = (0, 1)
    cost: float = np.inf
    placed: Placed | None = None


def learn(
    observations: Observations,
    reflection: Reflection,
    positions: np.ndarray,
    num_photos: int,
    tell: Callable[[int, int], None] = lambda done, total: None,
    given: GivenLight | None = None,
) -> Learned:
    """Learn from S points.

    What is no metal and mirrors little, and metal that mirrors much: from each of these starts materials and light are
    found in turn, and the one that fits better goes on. Where points of both kinds come of it, each kind alone is tried
    from there, and a second one must be worth it.

    Args:
        positions: [S, 3].
        num_photos: N.
        tell: told (turns done, all turns).
        given: the light, of which only turn and scale are to be found.
    """
    some = np.sort(np.random.default_rng(0).permutation(len(positions))[:MOST_POINTS])
    turns = _Turns(
        observations.select(some), reflection.select(torch.from_numpy(some)), positions[some], num_photos, given
    )
    total = 3 * FIRST_TURNS + MORE_TURNS + 2
    done = iter(range(total))

    def turned(state: _State, times: int, expose: bool = True) -> _State:
        for _ in range(times):
            tell(next(done), total)
            state = turns.turn(state, expose)
        return state

    starts = [turned(turns.start(metallic), FIRST_TURNS, expose=False) for metallic in (0.0, 1.0)]
    state = turned(min(starts, key=lambda each: each.cost), MORE_TURNS)
    if len(state.materials.metallic.unique()) > 1:
        ones = [turned(replace(state, kinds=(kind,)), 1) for kind in (0, 1)]
        one = turned(min(ones, key=lambda each: each.cost), FIRST_TURNS)
        state = state if state.cost < (1 - BOTH_WORTH) * one.cost else one
    everything = _Turns(observations, reflection, positions, num_photos, given)
    return everything.end(state)


class _Turns:
    """The loop's body, and what does not change in it."""

    def __init__(
        self,
        observations: Observations,
        reflection: Reflection,
        positions: np.ndarray,
        num_photos: int,
        given: GivenLight | None,
    ) -> None:
        self.reflection, self.given = reflection, given
        self.raw, self.weights = torch.from_numpy(observations.colors), torch.from_numpy(observations.weights)
        self.photos, self.num_photos = torch.from_numpy(observations.photos), num_photos
        shown = (self.raw * self.weights[..., None]).sum(1) / self.weights.sum(1, keepdim=True).clamp_min(1e-9)
        self.near = neighbors(positions, shown.numpy())
        self.paints = few_colors(decoded(shown).numpy())
        self.paint = np.unique(self.paints, axis=0, return_inverse=True)[1].reshape(-1)

    def start(self, metallic: float) -> _State:
        """The light that was given, where it fits best; else one that is the same from all sides."""
        count = len(self.raw)
        mean = decoded(self.raw[self.weights > 0]).mean()
        light = torch.full((2 * LIGHT_ROWS**2, 3), 2 * float(mean))
        paints = (torch.from_numpy(self.paints) / (2 * mean)).clamp(0, BRIGHTEST)
        materials = Materials(paints, torch.full((count,), 0.3), torch.full((count,), metallic))
        placed = None
        if self.given is not None:
            placed = self.given.find(self.reflection, self.raw, self.weights, materials)
            light = self.given.light(placed)
        return _State(light, materials, torch.ones(self.num_photos), placed=placed)

    def turn(self, state: _State, expose: bool) -> _State:
        """Light from materials, materials from light and, where asked, gains from both."""
        some = torch.from_numpy(np.random.default_rng(0).permutation(len(self.raw))[:LIGHT_POINTS])
        of_some = Materials(*(values[some] for values in vars(state.materials).values()))
        observed = balanced(self.raw, state.gains, self.photos)
        seen = self.reflection.select(some), observed[some], self.weights[some], of_some
        placed = state.placed
        if self.given is None or placed is None:
            light = find_light(*seen, state.light)
        else:
            placed = self.given.refined(Part(*seen, torch.arange(len(some)), free=True), placed)
            light = self.given.light(placed)
        choice = self._choose(observed, light, state.kinds)
        paints = torch.from_numpy(few_colors(choice.color.numpy()))
        materials = Materials(paints, torch.tensor(ROUGHNESSES)[choice.best % LEVELS], (choice.best // LEVELS).float())
        gains = state.gains
        if expose:
            radiance = radiance_of(self.reflection, observed, self.weights, materials, light)
            gains = gains * exposures(radiance, observed, self.weights, self.photos, self.num_photos)
        return _State(light, materials, gains, state.kinds, choice.cost, placed)

    def end(self, state: _State) -> Learned:
        """The materials of all points under the light that was found, and the conventions for what nothing tells."""
        # Where the light came out too dark, base colours say by how much.
        observed = balanced(self.raw, state.gains, self.photos)
        choice = self._choose(observed, state.light, state.kinds, brightest=np.inf)
        light, placed, color = state.light, state.placed, choice.color
        if placed is None:
            light, color = grey_world(light, color, torch.from_numpy(solid_angles(LIGHT_ROWS).reshape(-1)))
        metal, brightness = bool((choice.best // LEVELS).all()), 1.0
        if metal:
            brightness = METAL / max(float(color.amax(1).median()), 1e-3)
        elif placed is None:
            brightness = min(WHITE / max(float(color.amax(1).quantile(0.95)), 1e-3), 1.0)
        if brightness != 1.0:
            light, color = light / brightness, color * brightness
            placed = None if placed is None else replace(placed, scale=placed.scale / brightness)
        found = tuple(
            _material(candidate, choice.shared[choice.which == k]) for k, candidate in enumerate(choice.chosen)
        )
        return Learned(
            light=light.reshape(LIGHT_ROWS, 2 * LIGHT_ROWS, 3).numpy(),
            materials=found,
            which=choice.which,
            color=color.clamp(max=BRIGHTEST).numpy(),
            gains=state.gains.numpy(),
            cost=choice.cost,
            placed=placed,
        )

    def _choose(self, observed: Tensor, light: Tensor, kinds: Sequence[int], brightest: float = BRIGHTEST) -> _Choice:
        """The few candidates of these kinds that explain all points best."""
        costs, colors = try_out(self.reflection, observed, self.weights, light, kinds, brightest)
        costs = costs.flatten(1)
        shared = heard(costs.numpy(), self.near)
        chosen = np.array(choose_few(shared))
        best = chosen[of_one_kind(shared[:, chosen], chosen // LEVELS, self.paint, BOTH_WORTH).argmin(1)]
        used, which = np.unique(best, return_inverse=True)
        rows, best = torch.arange(len(best)), torch.from_numpy(best)
        color, cost = colors.flatten(1, 2)[rows, best], float(costs[rows, best].mean())
        return _Choice(used.tolist(), which, best, color, shared, cost)


def _material(candidate: int, costs: np.ndarray) -> Material:
    """A chosen candidate, its roughness refined by the parabola through its own costs and its neighbours'."""
    metallic, level = divmod(candidate, LEVELS)
    curve = costs[:, metallic * LEVELS : (metallic + 1) * LEVELS].mean(0)
    roughness = ROUGHNESSES[level]
    if 0 < level < LEVELS - 1:
        below, here, above = curve[level - 1 : level + 2]
        bend = below - 2 * here + above
        if bend > 0:
            roughness += float(np.clip(0.5 * (below - above) / bend, -0.5, 0.5)) * (ROUGHNESSES[1] - ROUGHNESSES[0])
    sides = [curve[at] for at in (level - 2, level + 2) if 0 <= at < LEVELS]
    return Material(metallic, level, roughness, told=bool(min(sides) > (1 + TOLD_MARGIN) * curve[level]))
