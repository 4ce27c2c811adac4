"""The basis in which 3DGS files keep colours: real spherical harmonics with the Condon-Shortley phase, to degree 3."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float

C0 = 0.28209479177387814


def basis(directions: Float[np.ndarray, "*any 3"], degree: int) -> Float[np.ndarray, "*any k"]:
    """Values [..., (degree + 1)²] at unit directions [..., 3], in the order (l, m) = (0, 0), (1, -1), (1, 0), (1, 1),
    (2, -2), ...; degree 3 at most. Source: `sh_utils` of Kerbl et al. 2023, as in KHR_gaussian_splatting, appendix A.
    """
    if not 0 <= degree <= 3:
        raise ValueError(f"expected a degree of 0 to 3, got {degree}")
    x, y, z = np.moveaxis(np.asarray(directions, dtype=np.float64), -1, 0)
    xx, yy, zz = x * x, y * y, z * z
    values = [
        np.full_like(x, C0),
        -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
        1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy), 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy), 1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]  # fmt: skip
    return np.stack(values[: (degree + 1) ** 2], axis=-1)
