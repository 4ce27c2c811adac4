"""A drawing of the capture from above and from the side: cameras, sparse points, the region of interest, the ground."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from stages.geometry.cameras import PosedScene
from stages.geometry.place import BOX_EDGES

SIDE = 360  # of each view, drawing units
MAX_POINTS = 2500
# The drawing shows this much beyond the sphere, in its radii, or all cameras where they are nearer than the limit.
MIN_REACH, MAX_REACH, AIR = 1.3, 12.0, 1.08
COLORS = {"point": "#8a94a3", "inside": "#3c8d5a", "camera": "#2f6fb0", "region": "#d9822b", "ground": "#a0522d"}


def overview_svg(scene: PosedScene, box_corners: np.ndarray | None = None) -> Markup:
    """An SVG for a page, with two views of the scene frame: from above (x right, y up) and from the side (x, z).

    Args:
        box_corners: [8, 3] scene frame, of the box that the mesh is cropped to; see `GivenRegion.box_corners`.
    """
    centers = scene.cameras.centers
    reach = float(np.clip(AIR * np.abs(centers).max(), MIN_REACH, MAX_REACH))
    thinned = scene.points[:: max(1, -(-len(scene.points) // MAX_POINTS))]
    views = []
    for column, (axis, title) in enumerate(((1, "from above"), (2, "from the side"))):
        left = column * (SIDE + 12)
        shapes = [_points(thinned, axis, reach), _region(box_corners, axis, reach)]
        if axis == 2 and scene.ground is not None:
            shapes.append(_ground(scene, reach))
        shapes.append(_cameras(centers, scene.cameras.forward, axis, reach))
        views.append(
            f'<svg x="{left}" y="0" width="{SIDE}" height="{SIDE}" viewBox="0 0 {SIDE} {SIDE}">'
            f'<rect width="{SIDE}" height="{SIDE}" fill="none" stroke="#8884"/>{"".join(shapes)}'
            f'<text x="8" y="18" font-size="12" fill="#888" font-family="sans-serif">{title}</text></svg>'
        )
    width = 2 * SIDE + 12
    return Markup(  # numbers and titles of ours: there is nothing to escape
        f'<svg viewBox="0 0 {width} {SIDE}" role="img" '
        f'aria-label="Cameras, points and region of interest">{"".join(views)}</svg>'
    )


def _on_page(points: np.ndarray, axis: int, reach: float) -> np.ndarray:
    """Drawing positions [P, 2] of scene points [P, 3]: x to the right, coordinate `axis` up."""
    return SIDE / 2 * (1 + points[:, (0, axis)] / reach * (1, -1))


def _points(points: np.ndarray, axis: int, reach: float) -> str:
    """Dots, those inside the region in their own colour; each set is one path of short strokes."""
    inside = np.linalg.norm(points, axis=1) < 1
    paths = []
    for kind, chosen in (("point", points[~inside]), ("inside", points[inside])):
        page = _on_page(chosen, axis, reach)
        page = page[((page >= 0) & (page <= SIDE)).all(1)]
        strokes = "".join(f"M{x:.1f} {y:.1f}h1" for x, y in page)
        paths.append(f'<path d="{strokes}" stroke="{COLORS[kind]}" stroke-width="1" fill="none"/>')
    return "".join(paths)


def _region(box_corners: np.ndarray | None, axis: int, reach: float) -> str:
    """The unit sphere, and the box where there is one."""
    middle, stroke = SIDE / 2, f'fill="none" stroke="{COLORS["region"]}" stroke-width="1.5"'
    shapes = f'<circle cx="{middle}" cy="{middle}" r="{SIDE / 2 / reach:.1f}" {stroke}/>'
    if box_corners is not None:
        page = _on_page(box_corners, axis, reach)
        path = "".join(f"M{page[i, 0]:.1f} {page[i, 1]:.1f}L{page[j, 0]:.1f} {page[j, 1]:.1f}" for i, j in BOX_EDGES)
        shapes += f'<path d="{path}" {stroke}/>'
    return shapes


def _ground(scene: PosedScene, reach: float) -> str:
    """The ground in the side view, where it meets the plane y = 0."""
    assert scene.ground is not None
    normal, offset = scene.ground.normal, scene.ground.offset
    if abs(normal[2]) < 0.1:
        return ""
    ends = np.array([[x, 0.0, (offset - normal[0] * x) / normal[2]] for x in (-reach, reach)])
    (x0, y0), (x1, y1) = _on_page(ends, 2, reach)
    return (
        f'<path d="M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}" stroke="{COLORS["ground"]}" '
        'stroke-width="1.5" stroke-dasharray="6 4" fill="none"/>'
    )


def _cameras(centers: np.ndarray, forward: np.ndarray, axis: int, reach: float) -> str:
    """A dot for each camera, of `centers` [N, 3], with a stroke to where it looks, unit directions [N, 3]."""
    start, end = (_on_page(points, axis, reach) for points in (centers, centers + 0.08 * reach * forward))
    shapes = [
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.5"/><path d="M{x:.1f} {y:.1f}L{u:.1f} {v:.1f}"/>'
        for (x, y), (u, v) in zip(start, end, strict=True)
    ]
    color = COLORS["camera"]
    return f'<g fill="{color}" stroke="{color}" stroke-width="1.2">{"".join(shapes)}</g>'
