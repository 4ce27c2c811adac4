"""The captures: what people photograph, and how, other than a thing on a table in the middle of a circle of photos.

A photo of the default camera shows 1.33 times its distance across and 1.0 times up (upright: the other way round).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.captures.model import SIZE, Capture, Thing
from benchmarks.captures.shapes import (
    BRICK,
    CLOTH,
    FUR,
    GREEN,
    METAL,
    PLASTER,
    STONE,
    WOOD,
    block,
    clutter,
    figure,
    ground,
    lump,
    rod,
    room,
    sheet,
    tube,
    wood,
)
from benchmarks.captures.walks import on_circle, orbit, rows, shot

UPRIGHT = (SIZE[1], SIZE[0])
PLAIN = 0.06  # of the texture, of a subject without any: a few features at dirt and edges

Make = Callable[[np.random.Generator], Capture]


@dataclass(frozen=True)
class Kind:
    """A capture and what is hard in it."""

    shows: str
    make: Make


# ---------------------------------------------------------------- larger than the frame
def boulder(rng: np.random.Generator) -> Capture:
    """Each photo looks at another part of it from an arm's length."""
    subject = (lump((0, 0, 0.9), (3.2, 2.0, 2.0), 0.8, STONE, rng, 0.2),)
    eyes = on_circle((0, 0, 0), 1.0, (1.0, 1.6, 2.2), 360, 36)
    stretch = np.array([2.7, 2.1, 1.0])
    shots = [shot(eye * stretch, eye * [1.3, 0.8, 0.6] + [0, 0, rng.uniform(-0.2, 0.4)], rng) for eye in eyes]
    return Capture(subject, wood(rng, 40, 6, 25), np.array(shots))


def car(rng: np.random.Generator) -> Capture:
    """A car walked around close by, upright photos of what lies ahead; its paint is plain."""
    subject = (
        block((0, 0, 0.62), (4.3, 1.75, 0.65), 0.15, METAL),
        block((-0.2, 0, 1.15), (2.2, 1.5, 0.5), 0.3, METAL),
        *(lump((x, y, 0.32), (0.64, 0.22, 0.64), 0.8, FUR) for x in (-1.35, 1.35) for y in (-0.8, 0.8)),
    )
    eyes = on_circle((0, 0, 0), 1.0, (1.4, 1.7), 360, 36)
    shots = [shot(eye * [3.6, 2.4, 1.0], eye * [1.9, 0.8, 0.45], rng) for eye in eyes]
    street = (ground(80, 0.6), *clutter(rng, 14, (-20, 8, 0), (20, 16, 0), (2, 6)))
    return Capture(subject, street, np.array(shots), UPRIGHT)


# ---------------------------------------------------------------- off the middle
def low_left(rng: np.random.Generator) -> Capture:
    """A vase on a table, in the lower left of every photo."""
    subject = (
        lump((0, 0, 0.95), (0.24, 0.24, 0.3), 0.8, CLOTH, rng, 0.08),
        rod((0, 0, 1.05), (0, 0, 1.22), 0.05, 0.8, CLOTH, 1.4),
    )
    inside = (*room((0, 0, 0), (6, 5, 2.6), 0.3, 0.5), block((0, 0, 0.78), (1.6, 1.0, 0.04), 0.6))
    shots = orbit((0, 0, 1.0), 0.8, (1.2, 1.5), rng, framed=(-0.3, 0.22))
    return Capture(subject, inside, shots)


def before_a_hedge(rng: np.random.Generator) -> Capture:
    """A statue; the photographer pans along the hedge behind it, so that the axes meet two metres behind."""
    subject = figure((0, 0, 0), 1.8, 0.7, rng)
    garden = (ground(60, 0.7, GREEN), sheet((0, 2.6, 1.5), (0, -1, 0), (14, 3), 0.9, GREEN, rng, 0.4))
    eyes = on_circle((0, 2.0, 0), 4.4, (1.4, 1.7), 100, 24)
    return Capture(subject, garden, np.array([shot(eye, (0, 2.0, 1.1), rng) for eye in eyes]))


def beside(rng: np.random.Generator) -> Capture:
    """A lamp at one side of every photo of a walk past it, the rest of the room at the other."""
    subject = (
        rod((0, 0, 0), (0, 0, 0.05), 0.2, 0.4, METAL),
        rod((0, 0, 0.05), (0, 0, 1.4), 0.025, 0.4, METAL),
        rod((0, 0, 1.35), (0, 0, 1.7), 0.28, 0.6, CLOTH, 0.6),
    )
    inside = (*room((1, 0.5, 0), (7, 7, 2.7), 0.4, 0.5), *clutter(rng, 8, (1.5, 2, 0), (4, 3.8, 0), (0.4, 1.2)))
    eyes = on_circle((0, 0, 0), 2.1, (1.3, 1.6), 160, 24, toward_deg=-70)
    return Capture(subject, inside, np.array([shot(eye, (0, 0, 0.85), rng, (-0.38, 0.05)) for eye in eyes]))


# ---------------------------------------------------------------- from one side
def relief(rng: np.random.Generator) -> Capture:
    """A relief on a wall in rows of photos straight ahead."""
    subject = (sheet((0, -0.02, 1.6), (0, -1, 0), (3.2, 1.6), 0.8, STONE, rng, 0.18, 5),)
    wall = (sheet((0, 0, 2), (0, -1, 0), (14, 5), 0.4, PLASTER), ground(20, 0.4))
    return Capture(subject, wall, rows(np.linspace(-1.5, 1.5, 8), (1.1, 1.6, 2.1), 1.5, rng))


def facade(rng: np.random.Generator) -> Capture:
    """The front of a house in two rows from across the street, and six photos from its ends."""
    subject = (
        sheet((0, 0, 4.5), (0, -1, 0), (14, 9), 0.6, BRICK),
        *(block((x, -0.1, z), (1.2, 0.3, 1.6), 0.7, PLASTER) for x in (-5, -1.7, 1.7, 5) for z in (2, 5, 7.6)),
        *(block((x, -0.6, 3.6), (2.4, 1.2, 0.9), 0.6, STONE) for x in (-5, 5)),
        block((0, -0.4, 9.1), (14.6, 1.0, 0.5), 0.6, STONE),
    )
    street = (
        ground(120, 0.5),
        *(block((x, 4, 4), (10, 8, 8 + 2 * k), 0.5, BRICK) for k, x in enumerate((-13, 13))),
        *(rod((x, -6, 0), (x, -6, 5), 0.12, 0.7, WOOD, 0.7) for x in (-16, 17)),
    )
    ahead = [shot((x, -9, z), (x, 0, 1.5 * z + 2), rng) for x in np.linspace(-6, 6, 9) for z in (1.5, 1.9)]
    oblique = [shot((x, -9, 1.6), (0.4 * x, 0, 4.5), rng) for x in (-11, -9.5, -8, 8, 9.5, 11)]
    return Capture(subject, street, np.array(ahead + oblique))


def trophy(rng: np.random.Generator) -> Capture:
    """A stuffed head on a wall, walked around from side to side, with the wall behind it."""
    subject = (
        lump((0, -0.03, 1.9), (0.5, 0.06, 0.7), 0.6, WOOD),
        rod((0, -0.03, 1.85), (0, -0.42, 2.0), 0.17, 0.7, FUR, 0.75),
        lump((0, -0.5, 2.02), (0.26, 0.36, 0.28), 0.7, FUR, rng, 0.1),
        rod((0, -0.55, 2.0), (0, -0.85, 1.86), 0.085, 0.7, FUR, 0.6),
        *(rod((0.06 * s, -0.45, 2.12), (0.38 * s, -0.38, 2.5), 0.03, 0.6, CLOTH, 0.5) for s in (-1, 1)),
        *(rod((0.38 * s, -0.38, 2.5), (0.3 * s, -0.55, 2.78), 0.016, 0.6, CLOTH, 0.3) for s in (-1, 1)),
    )
    inside = (
        *room((0, -3, 0), (7, 6, 3.2), 0.5, 0.5),
        *(block((x, -0.02, 1.8), (0.6, 0.04, 0.8), 0.9, CLOTH) for x in (-1.6, 1.7)),
        block((-2.6, -0.3, 0.5), (1.2, 0.5, 1.0), 0.6),
    )
    return Capture(subject, inside, orbit((0, -0.35, 2.1), 1.45, (1.5, 1.75, 2.1), rng, span_deg=140))


def mask(rng: np.random.Generator) -> Capture:
    """A small mask on a wall, half orbit, off the middle of the photos, much wall around."""
    subject = (
        lump((0, -0.05, 1.6), (0.22, 0.2, 0.34), 0.7, WOOD, rng, 0.12),
        rod((0, -0.1, 1.6), (0, -0.21, 1.56), 0.03, 0.7),
    )
    inside = (
        *room((0, -2.5, 0), (6, 5, 2.7), 0.6, 0.5),
        *(block((x, -0.02, z), (0.3, 0.04, 0.4), 0.9, CLOTH) for x, z in ((-0.7, 1.7), (0.8, 1.5), (-0.9, 1.0))),
    )
    return Capture(subject, inside, orbit((0, -0.1, 1.6), 0.9, (1.4, 1.6, 1.8), rng, span_deg=120, framed=(0.12, -0.1)))


def niche(rng: np.random.Generator) -> Capture:
    """A statue in a niche: a third from afar, the rest close-ups of its parts."""
    subject = figure((0, 0.25, 1.0), 1.5, 0.6, rng)
    wall = (
        *(sheet((2.3 * s, 0, 2), (0, -1, 0), (3.4, 4), 0.5, STONE) for s in (-1, 1)),
        sheet((0, 0, 3.4), (0, -1, 0), (1.2, 1.2), 0.5, STONE),
        sheet((0, 0, 0.5), (0, -1, 0), (1.2, 1.0), 0.5, STONE),
        sheet((0, 0.8, 1.9), (0, -1, 0), (1.2, 1.8), 0.4, STONE),
        *(sheet((0.6 * s, 0.4, 1.9), (-s, 0, 0), (0.8, 1.8), 0.4, STONE) for s in (-1, 1)),
        *(block((0, 0.4, z), (1.2, 0.8, 0.04), 0.4, STONE) for z in (0.98, 2.82)),
        ground(20, 0.5),
    )
    wide = [shot(eye, (0, 0.25, 1.8), rng) for eye in on_circle((0, 0.25, 0), 3.0, (1.5, 1.7), 90, 8)]
    near = on_circle((0, 0.25, 0), 1.15, (1.3, 1.7, 2.1), 80, 16)
    return Capture(subject, wall, np.array(wide + [shot(eye, (0, 0.25, eye[2] - 0.05), rng) for eye in near]))


# ---------------------------------------------------------------- several, tall
def pair(rng: np.random.Generator) -> Capture:
    """Two ornaments on a table, two and a half of their sizes apart, one orbit around both."""
    subject = (
        lump((-0.28, 0, 0.86), (0.18, 0.18, 0.2), 0.8, CLOTH, rng, 0.15),
        *figure((0.28, 0, 0.77), 0.26, 0.8, rng, WOOD),
    )
    inside = (*room((0, 0, 0), (6, 5, 2.6), 0.3, 0.5), block((0, 0, 0.75), (1.5, 0.9, 0.04), 0.7))
    return Capture(subject, inside, orbit((0, 0, 0.87), 0.75, (1.1, 1.35), rng))


def gate_posts(rng: np.random.Generator) -> Capture:
    """Two stone lions at the sides of stairs, three sizes apart: half orbits of each from before them."""

    def lion(x: float) -> tuple[Thing, ...]:
        return (
            block((x, 0, 0.4), (0.6, 1.0, 0.8), 0.6, STONE),
            lump((x, 0.05, 1.1), (0.4, 0.8, 0.6), 0.7, STONE, rng),
            lump((x, -0.35, 1.5), (0.35, 0.35, 0.4), 0.7, STONE, rng),
        )  # fmt: skip

    stairs = tuple(
        block((0, 0.5 + 0.3 * k, 0.08 + 0.16 * k), (2.2, 0.3, 0.16 + 0.32 * k), 0.5, STONE) for k in range(6)
    )
    around = (*stairs, ground(50, 0.6), sheet((0, 3, 4), (0, -1, 0), (24, 8), 0.6, BRICK))
    shots = [orbit((x, -0.1, 1.0), 2.0, (1.3, 1.7), rng, span_deg=120, count=12) for x in (-1.6, 1.6)]
    return Capture((*lion(-1.6), *lion(1.6)), around, np.concatenate(shots))


def tall_clock(rng: np.random.Generator) -> Capture:
    """A tall clock against a wall, half orbit, upright photos at three heights, each of a part."""
    face = rod((0, -0.2, 1.75), (0, -0.21, 1.75), 0.17, 0.0, PLASTER)
    subject = (
        block((0, -0.02, 0.3), (0.55, 0.4, 0.6), 0.4),
        block((0, -0.02, 1.05), (0.4, 0.3, 0.95), 0.4),
        block((0, -0.02, 1.75), (0.5, 0.36, 0.5), 0.4),
        lump((0, -0.02, 2.05), (0.5, 0.3, 0.24), 0.4, WOOD),
        rod((0, -0.02, 2.1), (0, -0.02, 2.28), 0.04, 0.5, METAL, 0.4),
        face,
        *(
            rod((0, -0.215, 1.75), (0.12 * np.sin(a), -0.215, 1.75 + 0.12 * np.cos(a)), 0.008, 1.0, FUR)
            for a in (0.6, 2.4)
        ),
    )
    inside = (
        *room((0, -2.8, 0), (6, 6, 2.8), 0.3, 0.6),
        block((1.4, -0.1, 0.4), (1.2, 0.5, 0.8), 0.7),
        block((-1.3, 0.14, 1.6), (0.7, 0.05, 0.9), 0.9, CLOTH),
    )
    eyes = on_circle((0, 0, 0), 1.7, (0.7, 1.3, 1.8), 120, 24)
    return Capture(subject, inside, np.array([shot(eye, (0, -0.05, eye[2] - 0.1), rng) for eye in eyes]), UPRIGHT)


def column(rng: np.random.Generator) -> Capture:
    """A column of six metres from the ground: its foot, its middle and its top in different photos."""
    subject = (
        block((0, 0, 0.3), (1.2, 1.2, 0.6), 0.6, STONE),
        rod((0, 0, 0.6), (0, 0, 5.2), 0.36, 0.6, STONE, 0.8),
        block((0, 0, 5.3), (0.9, 0.9, 0.25), 0.6, STONE),
        *figure((0, 0, 5.4), 0.9, 0.6, rng),
    )
    square = (
        ground(70, 0.6),
        *clutter(rng, 16, (-30, 12, 0), (30, 30, 0), (4, 10)),
        *clutter(rng, 8, (-30, -30, 0), (30, -18, 0), (4, 10)),
    )
    eyes = on_circle((0, 0, 0), 4.5, (1.6,), 360, 12)
    return Capture(
        subject, square, np.array([shot(eye, (0, 0, aim), rng) for eye in eyes for aim in (1.2, 3.2, 5.2)]), UPRIGHT
    )


# ---------------------------------------------------------------- all around
def living_room(rng: np.random.Generator) -> Capture:
    """A room, photographed outwards from near its middle."""
    subject = (
        *room((0, 0, 0), (5.5, 4.5, 2.6), 0.4, 0.6),
        *(thing for y in (-1.7, 1.7) for thing in clutter(rng, 6, (-2.3, y - 0.1, 0), (2.3, y + 0.1, 0), (0.5, 1.1))),
    )
    eyes = on_circle((0, 0, 0), 0.8, (1.3, 1.6), 360, 24)
    return Capture(subject, (), np.array([shot(eye, eye * [4, 4, 0.85], rng) for eye in eyes]))


def across_the_room(rng: np.random.Generator) -> Capture:
    """A room from its walls, each photo across to the other side."""
    subject = (
        *room((0, 0, 0), (6, 5, 2.6), 0.4, 0.6),
        *clutter(rng, 6, (-2.6, -0.8, 0), (-2.2, 0.8, 0), (0.4, 0.8)),
        block((0.4, 0.2, 0.36), (1.4, 0.8, 0.72), 0.6),
    )
    eyes = [eye * [1.25, 1.0, 1.0] for eye in on_circle((0, 0, 0), 2.0, (1.5, 1.7), 360, 24)]
    return Capture(subject, (), np.array([shot(eye, -0.6 * eye * [1, 1, -1.6], rng) for eye in eyes]))


def corridor(rng: np.random.Generator) -> Capture:
    """A corridor walked through, looking ahead."""
    subject = (
        *room((0, 8, 0), (1.9, 16, 2.5), 0.5, 0.5),
        *(block((s * 0.93, y, 1.0), (0.05, 0.9, 2.0), 0.7) for s in (-1, 1) for y in (2, 6, 10, 14)),
    )
    shots = [shot((0.3 * (-1) ** k, 0.6 + 0.45 * k, 1.55), (0, 4.1 + 0.45 * k, 1.35), rng) for k in range(24)]
    return Capture(subject, (), np.array(shots))


# ---------------------------------------------------------------- outside
def hollow_trunk(rng: np.random.Generator) -> Capture:
    """A broken hollow trunk in a wood: close-ups of its opening, wider photos, other trees around."""
    subject = (tube((0, 0, -0.05), 2.6, 0.45, 0.1, 0.8, rng, 70),)
    near = on_circle((0, 0, 0), 1.25, (1.0, 1.5), 150, 14)
    wide = on_circle((0, 0, 0), 2.9, (1.4, 1.7), 200, 10)
    shots = [shot(eye, (0, 0, eye[2] - 0.1), rng) for eye in near] + [shot(eye, (0, 0, 1.2), rng) for eye in wide]
    return Capture(subject, wood(rng, 60, 4, 25), np.array(shots), UPRIGHT)


def tree_foot(rng: np.random.Generator) -> Capture:
    """The foot of a tree with its roots, whose stem leaves the photos above: what they show of it is the subject."""
    roots = [(np.cos(a), np.sin(a), 0.0) for a in np.linspace(0.3, 6.0, 7)]
    subject = (
        rod((0, 0, -0.1), (0, 0, 3.4), 0.5, 0.8, WOOD, 0.75),
        *(rod((0.35 * x, 0.35 * y, 0.3), (1.3 * x, 1.3 * y, -0.05), 0.16, 0.8, WOOD, 0.3) for x, y, _ in roots),
    )
    shots = orbit((0, 0, 0.9), 2.3, (1.1, 1.6), rng, span_deg=300)
    return Capture(subject, wood(rng, 50, 5, 25), shots, UPRIGHT)


def shelf(rng: np.random.Generator) -> Capture:
    """A shelf of goods in one row of photos, moving along it."""
    boards = tuple(block((0, 0.2, z), (4.2, 0.4, 0.04), 0.5) for z in (0.2, 0.7, 1.2, 1.7))
    goods = tuple(
        thing for z in (0.22, 0.72, 1.22) for thing in clutter(rng, 14, (-2, 0.05, z), (2, 0.3, z), (0.1, 0.32))
    )
    back = (sheet((0, 0.42, 1.4), (0, -1, 0), (9, 2.8), 0.3, PLASTER), ground(16, 0.5))
    shots = rows(np.linspace(-1.9, 1.9, 24), (1.1,), 1.5, rng)
    return Capture(boards + goods, back, shots)


def hedge(rng: np.random.Generator) -> Capture:
    """A hedge along a path, one row of photos that look a little ahead, in turns up and down."""
    subject = (
        sheet((0, -0.1, 0.9), (0, -1, 0), (9, 1.8), 0.9, GREEN, rng, 0.5, 4),
        sheet((0, 0.3, 1.7), (0, -0.3, 1), (9, 0.9), 0.9, GREEN, rng, 0.2, 4),
    )
    field = (ground(80, 0.7, GREEN), *clutter(rng, 12, (-30, 15, 0), (30, 35, 0), (4, 9)))
    shots = [shot((x, -2.6, 1.6), (x + 0.5, 0, 0.9), rng) for x in np.linspace(-4.2, 3.6, 24)]
    return Capture(subject, field, np.array(shots))


# ---------------------------------------------------------------- on tables and floors
def cluttered_table(rng: np.random.Generator) -> Capture:
    """The easy one: a figure in the middle of a circle of photos; a desk full of other things behind it."""
    subject = figure((0, 0, 0.77), 0.4, 0.8, rng, CLOTH)
    inside = (
        *room((0, 0, 0), (6, 5, 2.6), 0.7, 0.6),
        block((0, 0, 0.75), (2.4, 1.6, 0.04), 0.8),
        *clutter(rng, 14, (-1.1, 0.45, 0.77), (1.1, 0.75, 0.77), (0.1, 0.3)),
        *clutter(rng, 8, (-1.1, -0.75, 0.77), (-0.6, 0.3, 0.77), (0.1, 0.2)),
    )
    return Capture(subject, inside, orbit((0, 0, 0.95), 0.62, (1.2, 1.45), rng))


def toy_on_a_floor(rng: np.random.Generator) -> Capture:
    """A small toy on a large patterned floor, walls far off, from standing height."""
    subject = (
        lump((0, 0, 0.14), (0.42, 0.2, 0.2), 0.7, CLOTH, rng, 0.1),
        lump((0.18, 0, 0.28), (0.16, 0.15, 0.16), 0.7, CLOTH, rng, 0.1),
    )
    hall = room((0, 0, 0), (20, 20, 6), 0.8, 0.8)
    return Capture(subject, hall, orbit((0, 0, 0.15), 0.9, (0.6, 1.0, 1.3), rng))


def _plain(make: Make) -> Make:
    return lambda rng: make(rng).plain(PLAIN)


KINDS: dict[str, Kind] = {
    "boulder": Kind("larger than the frame: close-ups all around", boulder),
    "car": Kind("larger than the frame, long, plain paint", car),
    "low_left": Kind("in the lower left of every photo", low_left),
    "before_a_hedge": Kind("the axes meet two metres behind it", before_a_hedge),
    "beside": Kind("at the left of every photo, the room at the right", beside),
    "relief": Kind("on a wall, three rows straight ahead", relief),
    "facade": Kind("two rows across the street, six oblique photos", facade),
    "trophy": Kind("sticks out of a wall, walked around", trophy),
    "mask": Kind("small on a wall, off the middle", mask),
    "niche": Kind("statue in a niche, wide photos and close-ups", niche),
    "pair": Kind("two things on a table, one orbit", pair),
    "gate_posts": Kind("two things, an orbit of each", gate_posts),
    "tall_clock": Kind("1 : 4 before a wall, three heights, plain face", tall_clock),
    "column": Kind("six metres tall, from the ground", column),
    "living_room": Kind("a room from its middle", living_room),
    "across_the_room": Kind("a room from its walls", across_the_room),
    "corridor": Kind("walked through", corridor),
    "hollow_trunk": Kind("close-ups and wide photos in a wood", hollow_trunk),
    "tree_foot": Kind("a stem that leaves the photos above", tree_foot),
    "shelf": Kind("one row along it", shelf),
    "hedge": Kind("one row, looking a little ahead", hedge),
    "cluttered_table": Kind("easy: in the middle, clutter behind", cluttered_table),
    "toy_on_a_floor": Kind("small, on a large patterned floor", toy_on_a_floor),
    "trophy, plain": Kind("few points on it, many on its wall", _plain(trophy)),
    "relief, plain": Kind("few points on it, many on its wall", _plain(relief)),
    "tall_clock, plain": Kind("few points on it, many around", _plain(tall_clock)),
    "pair, plain": Kind("few points on them, many on the table", _plain(pair)),
    "cluttered_table, plain": Kind("few points on it, many around", _plain(cluttered_table)),
}


def make(name: str) -> Capture:
    """The capture of this name, the same each time."""
    base = name.partition(",")[0]  # a plain one differs from its original in nothing else
    return KINDS[name].make(np.random.default_rng(list(base.encode())))
