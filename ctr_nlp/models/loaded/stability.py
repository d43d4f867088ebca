"""Stability of equilibria of a loaded robot, and their distance from snapping and from buckling.

A load that keeps its direction has an energy, of which K is the torsional part of the second variation, B that of
bending and V the rest. Jacobi's condition: as seen from the tip, responses D of all that can move (rod.Rod) stay
regular down to the base and on through the transmissions. With torsion that is softer by 1 / (1 - mu) the same
test decides whether K + V - mu K is positive definite, so that the stability margin is the least mu at which it
fails, as without a load; with bending and torsion both softer, it is the least mu of (K + B + V) x = mu (K + B) x,
the margin to buckling.

Where two eigenvalues pass zero together, as at Euler's load, det D has a double root and keeps its sign. Therefore
the test uses the pivots of D from place to place, which is, but for a positive factor, the stiffness of the part
beyond a place: there is a negative pivot for every direction that has lost its stability.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize.elementwise import find_root

from ctr_nlp.models.loaded.equilibria import LoadedEquilibria, States
from ctr_nlp.typing import Array, Flags, Index

MIN_REPORTED_MARGIN = -1023.0
"""Margin that is reported where a robot buckles however stiff its tubes are in torsion."""
MAX_COMPUTED_MARGIN = 0.9992
"""Margin above which 1 is reported: steps of integration are too long for torsion that is so soft."""
LOADED_MARGIN_TOLERANCE = 1e-7
"""Accuracy of a margin; equilibria and steps of integration have errors of the same size."""
SMOOTH_MARGIN_WIDTH = 0.02
"""Distance between the two margins at which a robot is tested for its smooth margin. Corners are rounded over
about as much.
"""


def margins(equilibria: LoadedEquilibria, states: States, bending: bool = False) -> Array:
    """Return the stability margins (T,) of states.

    With `bending`, they are margins to buckling, where bending is soft, too. equilibria: solver of the robots'
    structure and kind of load.
    """

    def held(at: Array, rows: Index) -> Array:
        """Return determinants at margins `at` of some rows; negative where any pivot is."""
        found = _pivots_at(equilibria, states.rows(rows), at, bending)
        with np.errstate(over="ignore", invalid="ignore"):
            # The determinant is the product of pivots: smooth in the margin, as root finding wants it, while the
            # sign comes from the pivots.
            size = np.nan_to_num(abs(found.prod(axis=(1, 2))), nan=1.0)
        return np.where(_positive(found), size, -size)

    every = np.arange(len(states.q))
    stable = held(np.zeros(len(every)), every) > 0
    # The sign at margin 0 shows on which side of it the root lies: in [0, MAX_COMPUTED_MARGIN] of a stable robot,
    # below 0 otherwise.
    low = np.where(stable, 0.0, -1.0)
    high = np.where(stable, MAX_COMPUTED_MARGIN, 0.0)
    falling = every[~stable]
    rising = every[stable]
    # Brackets double away from 1: 1 - mu, by which torsion is stiffened, goes 2, 4, 8, ...
    while len(falling):
        falling = falling[(held(low[falling], falling) <= 0) & (low[falling] > MIN_REPORTED_MARGIN)]
        high[falling], low[falling] = low[falling], 2 * low[falling] - 1
    found = np.where(low <= MIN_REPORTED_MARGIN, MIN_REPORTED_MARGIN, 1.0)
    # Stable with the softest torsion that is computed: the margin counts as 1, and no root is looked for.
    known = rising[held(high[rising], rising) > 0]
    left = np.setdiff1d(every[low > MIN_REPORTED_MARGIN], known)
    found[left] = find_root(
        held, (low[left], high[left]), args=(left,), tolerances={"xatol": LOADED_MARGIN_TOLERANCE}
    ).x
    return found


def smooth_margins(equilibria: LoadedEquilibria, states: States, at: Array) -> Array:
    """Return stability margins (T,) of states that are smooth functions of them.

    The margin is the least of several eigenvalues mu_i, and has a corner where two of them are equal: searches
    with second derivatives end there. With compliances nu = 1 / (1 - mu) of torsion the determinant is a multiple
    of prod_i (1 - nu / nu_i), and

        nu + h / (R - 1),   R = D(nu - h) / D(nu) = prod_i (1 + h / (nu_i - nu)),

    is a smooth function of all of them. It is nu exactly where the least nu_i above 0 is, and close to it while
    the others are farther. It takes two integrations of the rod instead of some ten.

    equilibria: solver of the robots' structure and kind of load. at (T,): margins, below 1, at which robots are
    tested. Numbers below them may be wrong (known_smooth_margins); 1 stands for no eigenvalue nearby.
    """
    return _smooth_margins(at, *_tested_responses(equilibria, states, at))


def known_smooth_margins(equilibria: LoadedEquilibria, states: States, at: Array) -> Array:
    """Return smooth margins (T,), NaN where they are wrong.

    Below the margins `at` (T,) they are right as long as a robot has lost one direction there, by less than the
    other eigenvalues are above.
    """
    here, below = _tested_responses(equilibria, states, at)
    found = _smooth_margins(at, here, below)
    # A negative pivot for every direction that is lost.
    lost = (pivots(here) < 0).sum(axis=(1, 2))
    return np.where((lost == 0) | ((lost == 1) & (found < at)), found, np.nan)


def _tested_responses(equilibria: LoadedEquilibria, states: States, at: Array) -> tuple[Array, Array]:
    """Return the responses (T, k, d + 2, d + 2) of states at margins (T,), and SMOOTH_MARGIN_WIDTH below."""
    here, below = (_responses_at(equilibria, states, mu) for mu in (at, at - SMOOTH_MARGIN_WIDTH))
    return here, below


def _smooth_margins(at: Array, here: Array, below: Array) -> Array:
    """Return smooth margins (T,) from the responses at margins `at` (T,) and below (_tested_responses)."""
    nu, lower = (1 / (1 - mu) for mu in (at, at - SMOOTH_MARGIN_WIDTH))
    determinants = np.linalg.det(here)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        softest = nu + (nu - lower) / ((np.linalg.det(below) / determinants).prod(axis=1) - 1)
        # What the load or the wall holds has eigenvalues nu_i below 0, and where these are nearer than the others
        # R is below 1. Where no tube acts on another R is 1, but for rounding.
        is_far = (np.sign(determinants).prod(axis=1) > 0) & ~(softest > nu)
        return np.where(is_far, 1.0, 1 - 1 / softest)


def least_margins(equilibria: LoadedEquilibria, states: States, groups: Index, known: Array) -> Array:
    """Return the least stability margin (n,) of the states in each of n groups, or the known one if that is less.

    equilibria: solver of the robots' structure and kind of load. groups (T,): number of each state's group, from
    0. known (n,): an upper bound for each group. Only states below that bound are solved for: all are tested at it
    in one batch, and of each group the one whose last pivot is least, which is likely to have the least margin, is
    solved for.
    """
    least = known.copy()
    left = np.arange(len(groups))
    while True:
        # One integration of the rod shows whether a state's margin is above a given one; finding the margin takes
        # several.
        at = np.clip(least[groups[left]], MIN_REPORTED_MARGIN, MAX_COMPUTED_MARGIN)
        found = _pivots_at(equilibria, states.rows(left), at, False)
        lower = ~_positive(found)
        left = left[lower]
        last = found[lower, -1].min(axis=1)
        if not len(left):
            return least
        ranked = left[np.lexsort((last, groups[left]))]
        # lexsort orders by group, then by last pivot: the first of each group is its most promising.
        first = ranked[np.append(True, np.diff(groups[ranked]) != 0)]
        np.minimum.at(least, groups[first], margins(equilibria, states.rows(first)))
        left = np.setdiff1d(left, first)


def _pivots_at(equilibria: LoadedEquilibria, states: States, margin: Array, bending: bool) -> Array:
    """Return the pivots (T, k, d + 2) of states at margins (T,); bending: whether bending is soft, too."""
    return pivots(_responses_at(equilibria, states, margin, bending))


def _responses_at(equilibria: LoadedEquilibria, states: States, margin: Array, bending: bool = False) -> Array:
    """Return the responses (T, k, d + 2, d + 2) of robots that are softer by margins (T,), as in _pivots_at."""
    # K + V - mu K has torsion of stiffness 1 - mu, that is of the compliance 1 / (1 - mu).
    torsion = 1 / (1 - margin)
    soft = np.stack([torsion, torsion if bending else np.ones_like(torsion)], axis=1)
    return np.asarray(equilibria.ends_of(states, soft).responses)


def _positive(found: Array) -> Flags:
    """Return whether all directions are stable, (T,): all pivots (T, k, d + 2) are positive numbers."""
    return np.asarray((found > 0).all(axis=(1, 2)))


def pivots(responses: Array) -> Array:
    """Return the pivots (T, k, d + 2) of responses (T, k, d + 2, d + 2), without row exchanges.

    By Gauss's elimination; NaN where responses are not finite. Exchanges would make signs of pivots meaningless.
    """
    left = responses.copy()
    found = np.empty(responses.shape[:3])
    with np.errstate(all="ignore"):
        for k in range(responses.shape[2]):
            found[..., k] = left[..., k, k]
            part = left[..., k + 1 :, k] / found[..., k, None]
            left[..., k + 1 :, k + 1 :] -= part[..., None] * left[..., k, None, k + 1 :]
    return found
