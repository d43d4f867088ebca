"""Margins of the planner beside those of the checker, where they are hardest to compute."""

import numpy as np
import pytest

from ctr_nlp import Robot, Tube
from ctr_nlp.check.stability import compute_stability_margins
from ctr_nlp.check.tubes import integrate, read_tubes
from ctr_nlp.models.dominant.shape import columns_of
from ctr_nlp.models.elastic import stability, torsion

pytestmark = pytest.mark.interpreted
DIAMETERS = (5.7, 2.2), (1.9, 1.4), (1.3, 1.0)
ROBOTS, PLACES = 20, 12


def random_robot(random):
    """Two or three long tubes whose curvature may change its sign."""
    d = int(random.integers(2, 4))
    curved = np.sort(random.uniform(60, 160, d))
    lengths = curved + np.sort(random.uniform(10, 150, d))
    bends = random.uniform([-1, 0], [1, 1], (d, 2)) * random.uniform(0.003, 0.05, (d, 1))
    rows = zip(lengths.tolist(), curved.tolist(), bends.tolist(), DIAMETERS[-d:], strict=True)
    return Robot(tuple(Tube(long, bent, tuple(k), *size, 0.3, max_strain=0.5) for long, bent, k, size in rows))


def test_margins_of_planner_and_checker_agree_on_long_bent_tubes():
    off, near_fold = [], 0
    for seed in range(ROBOTS):
        random = np.random.default_rng(seed)
        robot = random_robot(random)
        d, reach = robot.d, np.array([tube.curved_length for tube in robot.tubes])
        beta = reach * np.linspace(0.3, 1, PLACES)[:, None]
        x = np.hstack([random.uniform(-2, 2, (PLACES, d)), beta, np.zeros((PLACES, 2))])
        columns, tubes = columns_of(x), robot.tube_numbers
        parts = torsion.sections(tubes, columns[d : 2 * d], np)
        twisted = torsion.twist(tubes, columns, parts, np, steps=16)
        alpha = np.hstack(torsion.motors(tubes, columns, twisted))
        rates = np.hstack([rate + 0 * columns[0] for rate in twisted.rates])
        checked = read_tubes(robot.to_dict()).repeat(PLACES)
        theirs = compute_stability_margins(integrate(checked, alpha.T, beta.T, rates.T, sensitivities=False))
        known = theirs > 0.02
        near_fold += (known & (theirs < 0.5)).sum()
        off.append((abs(stability.margins(tubes, x) - theirs) - 0.005 * theirs)[known].max())
    assert max(off) < 0.002
    assert near_fold > 10
