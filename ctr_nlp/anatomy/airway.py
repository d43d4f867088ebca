"""Synthetic airways: from the trachea to a segmental bronchus, with sizes from published morphometry."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ctr_nlp.paths.curve import Curve, curve_from_points
from ctr_nlp.paths.points import cumulative_arc_length
from ctr_nlp.support.value_checks import check_choice
from ctr_nlp.typing import Array


class Generation(NamedTuple):
    """Least and largest diameter and length of a bronchus, mm."""

    name: str
    diameter: tuple[float, float]
    length: tuple[float, float]


GENERATIONS = (
    Generation("trachea", (18, 18), (100, 100)),
    Generation("right main bronchus", (15, 15), (22, 25)),
    Generation("intermediate bronchus", (12, 12), (19, 25)),
    Generation("lower-lobe bronchus and basal trunk", (11, 11), (10, 15)),
    Generation("segmental bronchus", (6, 8), (9, 15)),
)
BIFURCATION_DEG = (28.0, 40.0)
LEFT_UPPER = (
    Generation("trachea", (18, 18), (100, 100)),
    Generation("left main bronchus", (12, 13), (40, 50)),
    Generation("left upper-lobe bronchus", (9, 11), (10, 16)),
    Generation("superior division", (8, 10), (8, 14)),
    Generation("segmental bronchus", (5, 7), (9, 15)),
)
LEFT_UPPER_DEG = (40.0, 50.0), (50.0, 85.0), (30.0, 60.0), (25.0, 50.0)
"""Bifurcation angles towards the left upper lobe, which bends back: wider ranges than measured ones."""
LOBES = {
    "right lower": (GENERATIONS, (BIFURCATION_DEG,) * (len(GENERATIONS) - 1)),
    "left upper": (LEFT_UPPER, LEFT_UPPER_DEG),
}
"""Bronchi on the way to a lobe, and least and largest angle between each and the next."""
ROLL_DEG = (40.0, 90.0)
"""Between the bending planes of consecutive corners, to either side."""
ROUNDING_MM = (12.0, 25.0)
"""Radius at which a corner is rounded, the smaller where two corners share a short bronchus."""
AIRWAY_SPACING_MM = 0.5
TINY_MM = 1e-6
"""Corners that use up all of a bronchus leave no more of it straight."""


def synthetic_airway(seed: int = 0, lobe: str = "right lower") -> Curve:
    """Return the centreline of a random airway, from the trachea downwards, with the lumen's radius.

    seed: of numpy's default generator. lobe: one of LOBES, in whose segmental bronchus the airway ends. Raises
    OptionError for another lobe.
    """
    check_choice("lobe", lobe, LOBES)
    generations, bifurcations = LOBES[lobe]
    random = np.random.default_rng(seed)
    lengths = np.array([random.uniform(*generation.length) for generation in generations])
    diameters = np.array([random.uniform(*generation.diameter) for generation in generations])
    angles = np.radians(random.uniform(*np.transpose(bifurcations)))
    rolls = np.radians(random.uniform(*ROLL_DEG, len(angles))) * random.choice([-1, 1], len(angles))
    # The first bend has no plane before it, from which its own could be measured.
    rolls[0] = random.uniform(-np.pi, np.pi)
    # Length of bronchus that the rounding of each corner may use up: half of one between two corners, which share
    # it, and all of the first and of the last one.
    room = np.minimum(
        lengths[:-1] * np.where(np.arange(len(angles)) > 0, 0.5, 1), lengths[1:] * np.append(np.full(3, 0.5), 1)
    )
    # A rounding of radius r about an angle a takes r tan(a / 2) from both bronchi.
    widest = np.minimum(ROUNDING_MM[1], room / np.tan(angles / 2))
    rounding = random.uniform(np.minimum(ROUNDING_MM[0], widest), widest)
    points, corners = _path(lengths, angles, rolls, rounding)
    along = cumulative_arc_length(points)
    # A diameter is reached in the middle of its bronchus (of the outer two: at the airway's end); radii are linear
    # between.
    middles = np.concatenate([[0.0], (corners[1:] + corners[:-1]) / 2, [along[-1]]])
    return curve_from_points(points, np.interp(along, middles, diameters / 2))


def _path(lengths: Array, angles: Array, rolls: Array, rounding: Array) -> tuple[Array, Array]:
    """Return points every AIRWAY_SPACING_MM along bronchi and rounded corners, and the corners' arc lengths, mm.

    lengths: (k,) mm of the bronchi. angles, rolls (k - 1,): bend at each corner, and turn of its plane against the
    one before, rad. rounding (k - 1,): radii, mm. The third of the axes points along the path, the first towards
    the side of the next bend.
    """
    cut = rounding * np.tan(angles / 2)
    straights = lengths - np.append(0.0, cut) - np.append(cut, 0.0)
    axes = Rotation.identity()
    pieces = [np.zeros((1, 3))]
    corners = []
    length = 0.0
    for i, straight in enumerate(straights):
        if straight > TINY_MM:
            pieces.append(pieces[-1][-1] + np.outer(_steps(straight), axes.apply([0.0, 0.0, 1.0])))
        length += straight
        if i < len(angles):
            axes = axes * Rotation.from_euler("z", rolls[i])
            turn = _steps(rounding[i] * angles[i]) / rounding[i]
            bend = rounding[i] * np.column_stack([1 - np.cos(turn), 0 * turn, np.sin(turn)])
            pieces.append(pieces[-1][-1] + axes.apply(bend))
            axes = axes * Rotation.from_euler("y", angles[i])
            corners.append(length + rounding[i] * angles[i] / 2)
            length += rounding[i] * angles[i]
    return np.vstack(pieces), np.array(corners)


def _steps(length: float) -> Array:
    """Return evenly spaced arc lengths from 0 (excluded) to `length` (included), mm."""
    count = max(1, round(length / AIRWAY_SPACING_MM))
    return np.arange(1.0, count + 1) * (length / count)
