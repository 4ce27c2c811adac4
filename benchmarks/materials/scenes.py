"""The scenes: an object that floats in its light, photographed from all around, and where the held-out views are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.materials import objects
from benchmarks.materials.lights import LIGHTS
from benchmarks.synthetic.model import Part, Scene
from benchmarks.synthetic.scenes import Recipe, normalised
from stages.scenes.viewpoints import viewpoint

DISTANCE = 2.15  # of the cameras from the middle of the object, whose largest extent is 1
LOWEST_DEG, HIGHEST_DEG = -28.0, 68.0  # elevation of the photos' cameras
HELD_OUT_VIEWS = 8


@dataclass(frozen=True)
class Subject:
    """An object and the light it is photographed in.

    Attributes:
        shows: what it asks of a method.
        make: random numbers -> parts.
        light: one of LIGHTS; the others are those it is relit with.
    """

    shows: str
    make: Callable[[np.random.Generator], list[Part]]
    light: str

    @property
    def unseen(self) -> tuple[str, ...]:
        """The lights that the photos do not show."""
        return tuple(light for light in LIGHTS if light != self.light)


SUBJECTS = {
    "diffuse": Subject("one diffuse colour", objects.plaster_bracket, "sky"),
    "painted": Subject("many matte colours", objects.painted_bird, "room"),
    "polished": Subject("polished steel", objects.polished_dog, "studio"),
    "rough_metal": Subject("rough copper", objects.copper_knot, "sky"),
    "plastic": Subject("plastic with clear highlights", objects.plastic_jug, "room"),
    "mixed": Subject("paint, plastic and two metals on one object", objects.mixed_lantern, "studio"),
}


def make_scene(subject: Subject, rng: np.random.Generator, num_photos: int) -> Scene:
    """The object in the light that it is photographed in."""
    parts = normalised(subject.make(rng))
    middle = np.array([0, 0, max(part.vertices[:, 2].max() for part in parts) / 2])
    return Scene(parts, None, LIGHTS[subject.light](), around(middle, num_photos, rng))


RECIPES = {
    name: Recipe(subject.shows, lambda rng, count, subject=subject: make_scene(subject, rng, count))
    for name, subject in SUBJECTS.items()
}


def around(middle: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """[N, 4, 4] world-to-camera matrices: evenly over a belt of the sphere, most of it above, held by hand."""
    sines = np.sin(np.radians([HIGHEST_DEG, LOWEST_DEG]))
    poses = []
    for i in range(count):
        sine = sines[0] + (i + 0.5) / count * (sines[1] - sines[0])
        azimuth = i * np.pi * (3 - np.sqrt(5)) + rng.uniform(-0.1, 0.1)
        ring = np.sqrt(1 - sine**2)
        direction = np.array([ring * np.cos(azimuth), ring * np.sin(azimuth), sine])
        eye = middle + DISTANCE * rng.uniform(0.95, 1.05) * direction
        poses.append(viewpoint(eye, middle + rng.uniform(-0.03, 0.03, 3), roll=np.radians(rng.uniform(-3, 3))))
    return np.array(poses)
