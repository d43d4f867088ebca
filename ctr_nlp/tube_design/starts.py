"""Tubes that a design starts from: the robot's own, and random ones that can be made."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from ctr_nlp.ocp.shared.design import DESIGN_LENGTH_UNIT_MM, DesignedTubes
from ctr_nlp.typing import Array

MAX_EXTRA_WALL_MM, MAX_INNER_DIAMETER_GROWTH = 1.5, 0.6
"""Largest excess of a random tube over the least: of its wall, mm on both sides together, and of its inner
diameter, as a part of that.
"""
MAX_RANDOM_TUBE_TRIES = 1000
"""Largest number of random sets of tubes that are tried for one that can be made."""


def generate_start_tubes(tubes: DesignedTubes, seed: int) -> Iterator[tuple[str, Array]]:
    """Yield tubes to start from: the robot's own, then random ones that satisfy the rules.

    Parameters
    ----------
    tubes : DesignedTubes
        The tubes as unknowns, with rules.
    seed : int
        Seed of numpy's default generator.

    Yields
    ------
    name : str
        What the start is called.
    p : ndarray
        Unknowns (P,) of the tubes. Without end, unless MAX_RANDOM_TUBE_TRIES random ones in a row break a rule.
    """
    yield "the robot's own tubes", tubes.nominal_unknowns
    random = np.random.default_rng(seed)
    for number in itertools.count(1):
        drawn = (_sample_tubes(tubes, random) for _ in range(MAX_RANDOM_TUBE_TRIES))
        found = next((p for p in drawn if tubes.satisfies_rules(p)), None)
        if found is None:
            return
        yield f"random tubes {number}", found


def _sample_tubes(tubes: DesignedTubes, random: np.random.Generator) -> Array:
    """Return random unknowns p (P,): tubes from the innermost outwards, and curvatures up to what the strain
    allows.
    """
    # A part in a million more than a rule asks for, so that rounding does not break it.
    rules = tubes.rules
    d = tubes.robot.d
    diameters = np.zeros((d, 2))
    inner = rules.channel * (1 + 1e-6)
    for i in reversed(range(d)):
        if i < d - 1:
            inner *= 1 + MAX_INNER_DIAMETER_GROWTH * random.random()
        # Squared: thin walls come up more often than thick ones.
        outer = inner + 2 * rules.wall * (1 + 1e-6) + MAX_EXTRA_WALL_MM * random.random() ** 2
        diameters[i] = outer, inner
        inner = outer + rules.clearance * (1 + 1e-6)
    curvatures = len(tubes.names) - 3 * d
    lower, upper = tubes.box
    found = np.concatenate([np.zeros(curvatures), _lengths(tubes, random), diameters.ravel()])
    for k, name in enumerate(tubes.names[:curvatures]):
        outer = diameters[int(name.rpartition("_")[2]) - 1, 0]
        # The strain k D / 2 at the outer fibre, solved for k and in 1/(100 mm), times a random part.
        found[k] = DESIGN_LENGTH_UNIT_MM * 2 * rules.strain_made / outer * random.uniform(0.02, 0.98)
    # The box has the fixed entries as equal bounds: clipping sets them.
    return np.clip(found, lower, upper)


def _lengths(tubes: DesignedTubes, random: np.random.Generator) -> Array:
    """Return lengths (d,) of curved parts, 100 mm, that grow inwards; the innermost reaches as far as the robot's
    own.
    """
    parts = np.append(np.sort(random.uniform(0.2, 0.9, tubes.robot.d - 1)), 1.0)
    return np.asarray(parts * tubes.robot.reach / DESIGN_LENGTH_UNIT_MM)
