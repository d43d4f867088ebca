"""Whether an equilibrium of a loaded robot is stable, and how far from the snap and from buckling.

A load that keeps its direction has an energy, of which K is the torsional part of the second variation, B that of
bending and V the rest. Jacobi's condition: as seen from the tip, responses D of all that can move (rod.Rod) stay
regular down to the base and on through the transmissions. With torsion that gives in 1 / (1 - mu) times as much it
tells the same of K + V - mu K, so that the stability margin is the least mu at which it fails, as without a load;
with bending and torsion giving in, it is the least mu of (K + B + V) x = mu (K + B) x, the margin to buckling.

Where two eigenvalues pass at once, as at Euler's load, det D has a double root and keeps its sign. Therefore not
determinants are looked at but the pivots of D from place to place, which is the stiffness of what lies beyond a
place but for a positive factor: one of them is negative for every direction that gave way.
"""

from __future__ import annotations

import numpy as np

from ctr_nlp.models.loaded.equilibria import LoadedEquilibria, States
from ctr_nlp.typing import Array, Flags, Index

LEAST = -1023.0
"""The margin of what buckles however stiff in torsion."""
MOST = 0.9992
"""A margin of more counts as 1: steps of integration are too long for torsion that gives in so much."""
HALVINGS, SECANTS = 8, 8
"""Of the bracket of a margin, and steps of the secant method within it."""


def margins(equilibria: LoadedEquilibria, states: States, bending: bool = False) -> Array:
    """The stability margins (T,) of states; bending: those to buckling, where bending gives in as well."""
    stable, _ = _looked_at(equilibria, states, np.zeros(len(states.q)), bending)
    low, high = np.where(stable, 0.0, -1.0), np.where(stable, MOST, 0.0)
    falling = np.flatnonzero(~stable)
    while len(falling):
        found, _ = _looked_at(equilibria, states.rows(falling), low[falling], bending)
        falling = falling[~found & (low[falling] > LEAST)]
        high[falling], low[falling] = low[falling], 2 * low[falling] - 1
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        found, _ = _looked_at(equilibria, states, middle, bending)
        low, high = np.where(found, middle, low), np.where(found, high, middle)
    return _refined(equilibria, states, low, high, bending)


def least_margins(equilibria: LoadedEquilibria, states: States, groups: Index, known: Array) -> Array:
    """The least stability margin of states in each of n groups, or the one known of it, (n,), if that is less.

    groups (T,): of states, from 0. Which states have less than the least known is looked at for all at once; of a
    group's the one whose last pivot is least there is likely to have the least.
    """
    least, left = known.copy(), np.arange(len(groups))
    while True:
        at = np.clip(least[groups[left]], LEAST, MOST)
        held, last = _looked_at(equilibria, states.rows(left), at, False)
        left, last = left[~held], last[~held]
        if not len(left):
            return least
        ranked = left[np.lexsort((last, groups[left]))]
        first = ranked[np.append(True, np.diff(groups[ranked]) != 0)]
        np.minimum.at(least, groups[first], margins(equilibria, states.rows(first)))
        left = np.setdiff1d(left, first)


def _refined(equilibria: LoadedEquilibria, states: States, low: Array, high: Array, bending: bool) -> Array:
    """The roots of the last determinant within brackets, by the method of false position (Illinois)."""
    (_, f_low), (most, f_high) = (_looked_at(equilibria, states, at, bending) for at in (low, high))
    single = (f_low > 0) & (f_high < 0)  # two roots at once are bracketed alone
    with np.errstate(divide="ignore", invalid="ignore"):
        for _ in range(SECANTS):
            at = np.where(single, high - f_high * (high - low) / (f_high - f_low), (low + high) / 2)
            held, value = _looked_at(equilibria, states, at, bending)
            f_low, f_high = np.where(held, value, f_low / 2), np.where(held, f_high / 2, value)
            low, high = np.where(held, at, low), np.where(held, high, at)
        root = high - f_high * (high - low) / (f_high - f_low)
    found = np.where(single & (root >= low) & (root <= high), root, (low + high) / 2)
    return np.where((high >= MOST) & most, 1.0, np.where(low <= LEAST, LEAST, found))


def _looked_at(equilibria: LoadedEquilibria, states: States, margin: Array, bending: bool) -> tuple[Flags, Array]:
    """Whether no direction gives way at margins (T,), and the last pivot, which is the first to."""
    torsion = 1 / (1 - margin)
    soft = np.stack([torsion, torsion if bending else np.ones_like(torsion)], axis=1)
    found = pivots(equilibria.ends_of(states, soft).responses)
    held = np.asarray((found > 0).all(axis=(1, 2)))
    return held, found[:, -1].min(axis=1)


def pivots(responses: Array) -> Array:
    """Those of responses (T, k, d + 2, d + 2), by elimination, (T, k, d + 2); NaN where they are not numbers."""
    left, found = responses.copy(), np.empty(responses.shape[:3])
    with np.errstate(all="ignore"):
        for k in range(responses.shape[2]):
            found[..., k] = left[..., k, k]
            part = left[..., k + 1 :, k] / found[..., k, None]
            left[..., k + 1 :, k + 1 :] -= part[..., None] * left[..., k, None, k + 1 :]
    return found
