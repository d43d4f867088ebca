"""Limits on how far the nominal robot's tips turn beyond its motors from frame to frame: rows over two frames
each.

Twist i (rad) is phi_i - alpha_i of the first scenario, whose phi_i is relative to the innermost tube's tip: what
tube i is turned against that tip beyond its motor, less what the innermost tube turns. Margins at frames do not
see a bifurcation between them; a motion whose twists hardly change from frame to frame cannot cross one there. A
robot that turns by much as a whole in a frame crosses one, too, so that its turn is not left out.
"""

from __future__ import annotations

import numpy as np

from ctr_nlp.ocp.scenarios import SharedMotion
from ctr_nlp.typing import Array, Flags


class TwistSteps:
    """Changes of twists from frame to frame, (k (d - 1),), as rows of a motion: one for every pair of neighbours.

    Methods take slopes (T, d - 1, n + P) of the twists of every frame over its q and over p.
    """

    def __init__(self, motion: SharedMotion) -> None:
        """Prepare."""
        self._d = motion.d
        most = motion.twist_steps
        self._frames = len(most)
        # An infinite limit marks the first frame of each task: no frame comes before it.
        self._after = np.flatnonzero(np.isfinite(most))
        self._most = np.repeat(most[self._after], self._d - 1)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the rows, rad."""
        return -self._most, self._most

    def free(self, of_q: Flags) -> Flags:
        """Return which rows a free unknown changes; of_q (T, n): which entries of q are free."""
        moving = np.asarray(of_q.any(axis=1))
        return np.repeat(moving[self._after] | moving[self._after - 1], self._d - 1)

    def values(self, q: Array, phi: Array) -> Array:
        """Return the values of the rows at q (T, n) and tips phi (T, S, k), rad."""
        d = self._d
        return self._differences_between_frames(phi[:, 0, : d - 1] - q[:, : d - 1]).ravel()

    def slopes(self, turns: Array) -> Array:
        """Return the slopes of the twists over q and p, (T, d - 1, n + P).

        turns (T, m, n + P): derivatives of the first robot's unknowns.
        """
        d = self._d
        found = turns[:, : d - 1].copy()
        # The - alpha_i in a twist; alpha is the first part of q.
        found[:, range(d - 1), range(d - 1)] -= 1.0
        return found

    def change_by_repair(self, repair: Array) -> Array:
        """Return the change of the rows by a change repair (T, m) of the first robot's unknowns at fixed q."""
        return self._differences_between_frames(repair[:, : self._d - 1]).ravel()

    def multiply_jacobian(self, slopes: Array, step: Array) -> Array:
        """Return the change of the rows by a step of q and p, given for every frame, (T, n + P).

        slopes (T, d - 1, n + P): of the twists.
        """
        return self._differences_between_frames((slopes @ step[..., None])[..., 0]).ravel()

    def multiply_transposed_jacobian(self, slopes: Array, rows: Array) -> Array:
        """Return the transposed Jacobian times a vector `rows` over the rows, frame by frame (T, n + P).

        slopes (T, d - 1, n + P): of the twists.
        """
        return np.asarray((slopes.swapaxes(1, 2) @ self._transposed_differences(rows)[..., None])[..., 0])

    def of_tips(self, rows: Array) -> Array:
        """Return the transposed Jacobian over the first robot's first d - 1 tips, times a vector over the rows:
        (T, d - 1).
        """
        return self._transposed_differences(rows)

    def square(self, slopes: Array, sigma: Array, blocks: Array, band: Array) -> None:
        """Add J' diag(sigma) J of the rows to a system's blocks and band (bordered.py).

        slopes: of the twists; sigma: of the rows; blocks (T, n + P, n + P); band: (width + 1, T n).
        """
        n = band.shape[1] // len(slopes)
        after = self._after
        here = slopes[after]
        there = slopes[after - 1]
        weights = sigma.reshape(-1, self._d - 1, 1)
        for frames, own in ((after, here), (after - 1, -there)):
            # A row is twist(after) - twist(before): over q, either frame has a part of its own; over p,
            # both add up to one slope.
            over = np.concatenate([own[..., :n], (here - there)[..., n:]], axis=2)
            square = over.swapaxes(1, 2) @ (weights * over)
            if frames is not after:
                square[:, n:, n:] = 0.0  # p's own part belongs to a row, not to each of its frames
            blocks[frames] += square
        # The block between the two frames, below the diagonal: row `after`, column `after - 1`.
        coupled = -here[..., :n].swapaxes(1, 2) @ (weights * there[..., :n])
        rows, columns = np.indices((n, n))
        # scipy's lower form: entry (i, j) of the matrix stands in row i - j, column j of the band.
        band[n + rows - columns, (after[:, None, None] - 1) * n + columns] += coupled

    def _differences_between_frames(self, twists: Array) -> Array:
        """Return the changes of twists (T, ..) from frame to frame, within each task."""
        return np.asarray(twists[self._after] - twists[self._after - 1])

    def _transposed_differences(self, rows: Array) -> Array:
        """Return the transposed differences times a vector over the rows, (T, d - 1).

        An entry counts plus in its frame and minus in the one before.
        """
        each = rows.reshape(-1, self._d - 1)
        found = np.zeros((self._frames, self._d - 1))
        found[self._after] += each
        found[self._after - 1] -= each
        return found
