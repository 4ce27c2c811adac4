"""Pictures of the page: read, shrunk, drawn, packed into data URIs."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np

from stages.artifacts import AtlasMesh

STILL_SIDE = 480
PICTURE_SIDE = 768
MAX_PREVIEWS = 4
PROVENANCE_COLORS = {"PHOTO": "#3c8d5a", "FIELD": "#d9822b", "PADDING": "#8a94a3", "OUTSIDE": "#3a3f47"}
PROVENANCE_LABELS = {"PHOTO": "photos", "FIELD": "learned colour"}


def read_rgb(path: Path) -> np.ndarray:
    """[H, W, 3] uint8 RGB. Raises ValueError where the file is no image."""
    import cv2

    data = np.frombuffer(path.read_bytes(), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if image is None:
        raise ValueError(f"expected an image, got {path}")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def shrink(image: np.ndarray, side: int) -> np.ndarray:
    """The image with its longest side at most `side` pixels."""
    import cv2

    height, width = image.shape[:2]
    factor = side / max(height, width)
    if factor >= 1:
        return image
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def jpeg_uri(image: np.ndarray, quality: int = 85) -> str:
    """[H, W, 3] uint8 RGB as a data URI."""
    import cv2

    _, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


def data_uri(image: np.ndarray, suffix: str) -> str:
    """[H, W, 3] uint8 RGB as a data URI of a format without loss, such as ".png"."""
    import cv2

    _, data = cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    return f"data:image/{suffix[1:]};base64," + base64.b64encode(data.tobytes()).decode()


def draw_stills(atlas: AtlasMesh, texture: np.ndarray, up: np.ndarray) -> list[np.ndarray]:
    """The model from four sides: with its texture, then its shape alone."""
    from stages.drawing.rendering import render_textured, turntable

    views = turntable(atlas.vertices, up, 4, STILL_SIDE, STILL_SIDE)
    grey = np.full((1, 1, 3), 205, dtype=np.uint8)
    looks = ((texture, False), (grey, True))
    return [render_textured(atlas, colors, view, shaded) for colors, shaded in looks for view in views]


def describe_provenance(path: Path) -> dict[str, Any] | None:
    """The provenance map in colours and the shares of the charts' texels; None where it is missing."""
    import cv2

    from stages.texture.baking import Provenance

    kinds = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.exists() else None
    if kinds is None:
        return None
    palette = np.zeros((256, 3), dtype=np.uint8)
    for kind in Provenance:
        palette[kind] = [int(PROVENANCE_COLORS[kind.name][k : k + 2], 16) for k in (1, 3, 5)]
    counts = {kind: int((kinds == kind).sum()) for kind in (Provenance.PHOTO, Provenance.FIELD)}
    total = max(sum(counts.values()), 1)
    return {
        "image": jpeg_uri(shrink(palette[kinds], PICTURE_SIDE)),
        "parts": [
            {
                "label": PROVENANCE_LABELS[kind.name],
                "color": PROVENANCE_COLORS[kind.name],
                "share": f"{100 * count / total:.1f} %",
            }
            for kind, count in counts.items()
        ],
    }


def training_previews(folder: Path) -> list[dict[str, str]]:
    """A few of the renders made while training, evenly spread, the last one among them."""
    files = sorted(folder.glob("*.png")) if folder.is_dir() else []
    if len(files) > MAX_PREVIEWS:
        files = [files[i] for i in np.linspace(0, len(files) - 1, MAX_PREVIEWS).round().astype(int)]
    previews = []
    for file in files:
        try:
            image = jpeg_uri(shrink(read_rgb(file), PICTURE_SIDE))
        except (OSError, ValueError):
            continue
        label = f"preview at step {int(file.stem)}" if file.stem.isdigit() else file.stem
        previews.append({"image": image, "label": label})
    return previews
