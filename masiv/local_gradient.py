"""Deformation gradients of a cloud of points from the motion of their neighbours."""

from __future__ import annotations

import numpy as np


def local_gradients(rest: np.ndarray, now: np.ndarray) -> np.ndarray:
    """Least-squares gradients (M, 3, 3) [1] that take neighbourhoods (M, k, 3) [m] from ``rest`` to ``now``.

    F = (sum dx dX^T) (sum dX dX^T)^-1 with dX, dx relative to the mean of a neighbourhood. Exact for an affine motion
    of neighbours that span three dimensions.
    """
    before, after = rest - rest.mean(1, keepdims=True), now - now.mean(1, keepdims=True)
    spread = np.einsum("mki,mkj->mij", before, before)
    ridge = 1e-9 * np.trace(spread, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    return np.einsum("mki,mkj->mij", after, before) @ np.linalg.inv(spread + ridge)
