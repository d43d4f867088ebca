"""What tests compute over all rows of a chain and the product does row by row in C."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ctr_nlp.chain import Chain

Array = npt.NDArray[np.float64]


def times(chain: Chain, jacobian: Array, x: Array) -> Array:
    """The Jacobian of all rows, with that of the frames' constraints (T, m, n), times x: (rows,)."""
    frames, _, n = jacobian.shape
    of_frames = (jacobian @ x.reshape(frames, n, 1)).ravel()
    return np.concatenate([x, of_frames, chain.difference @ x])
