"""300 plans of random robots, paths and thresholds: verdicts against numbers computed here from their shapes."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from ctr_nlp import Problem, Robot, Tube, curve_from_points, growing
from ctr_nlp.paths.lumen import Lumen
from ctr_nlp.plan.verdicts import NO, NOT_CHECKED, YES
from ctr_nlp.view.exchange.configurations import plan_through

FRAMES = 4
SUBSTEPS = 10
CLOSE = 0.01
"""mm: a number so near to its limit may count on either side of it. The wall here has chords for its path,
0.5 mm long, which leave the path by some thousandths of a mm."""


def robots(random):
    """A robot of two tubes, the inner one longer."""
    outer, inner = random.uniform(60, 100), random.uniform(110, 160)
    curved = random.uniform(30, 55), random.uniform(60, 100)
    tubes = (
        Tube(outer, curved[0], random.uniform(0, 0.012), 3.0, 2.4),
        Tube(inner, curved[1], random.uniform(0.002, 0.02), 2.0, 1.4),
    )
    return Robot(tubes)


def problems(random, robot):
    """A path that bends at random to the side, with a radius that changes along it."""
    length = random.uniform(40, 0.95 * robot.tubes[1].curved_length)
    u = np.linspace(0, 1, 60)
    side = random.uniform(-12, 12, (2, 1)) * u**2 + random.uniform(-3, 3, (2, 1)) * np.sin(3 * u) * u
    points = np.column_stack([*side, length * u])
    radius = random.uniform(1.6, 4.0) + random.uniform(0, 1.0) * np.cos(random.uniform(1, 6) * u)
    curve = curve_from_points(points, radius)
    return Problem("random", robot, growing(curve, FRAMES), duration=4.0, lumen=curve)


def configurations(random, robot, lengths):
    """As the innermost tube follows the path's length, all angles change at random from frame to frame."""
    beta = np.asarray(lengths) * random.uniform(0.93, 1.05, FRAMES)
    outer = np.minimum(random.uniform(0.2, 0.9) * beta, robot.tubes[0].curved_length)
    alpha = np.cumsum(random.uniform(-0.5, 0.5, (FRAMES, 2)), axis=0) + random.uniform(-3, 3)
    theta = random.uniform(-0.05, 0.05, (FRAMES, 2))
    return np.column_stack([alpha, outer, beta, theta])


def densely(q):
    """Configurations at ten places on the way to each frame, the last of them the frame."""
    parts = np.arange(1, SUBSTEPS + 1)[:, None] / SUBSTEPS
    return np.concatenate([q[:1], *(a + parts * (b - a) for a, b in itertools.pairwise(q))])


def deepest(table, robot, beta, shapes):
    """Deepest contact, mm, of shapes (M, 101, 3) with a wall as far as the radius at the path's nearest point.

    The path is sampled so finely that its nearest sample stands for its nearest point.
    """
    lumen = Lumen(table)
    s = np.linspace(0, lumen.arc_lengths[-1], 20_001)
    centre = np.column_stack([np.interp(s, lumen.arc_lengths, column) for column in table[:, :3].T])
    radius = np.interp(s, lumen.arc_lengths, table[:, 3])
    distance, at = cKDTree(centre).query(shapes)
    within = np.linspace(0, 1, 101) * beta[:, 1:] <= beta[:, :1]  # still inside the outer tube
    outside = np.where(within, *(tube.outer_diameter / 2 for tube in robot.tubes))
    return (distance + outside - radius[at]).max()


def check(seed, arrival, error, contact):
    random = np.random.default_rng(seed)
    robot = robots(random)
    problem = problems(random, robot)
    q = configurations(random, robot, problem.target.lengths)
    model = ("elastic", "dominant")[seed % 2]
    plan = plan_through(problem, q, model)
    plan = plan.with_thresholds(arrival_tolerance=arrival, error_allowed=error, contact_allowed=contact)
    away = np.linalg.norm(plan.shape - plan.target, axis=2)
    weights = np.r_[0.5, np.ones(99), 0.5] / 100
    dense = densely(q)
    fine = Problem("fine", robot, growing(problem.lumen, len(dense)), duration=4.0, lumen=problem.lumen)
    moved = plan_through(fine, dense, model)
    depth = deepest(plan.lumen, robot, dense[:, 2:4], moved.shape)
    for verdict, number, limit in (
        (plan.verdicts.arrives, away[-1, -1], arrival),
        (plan.verdicts.follows, math.sqrt((away**2 @ weights).max()), error),
        (plan.verdicts.within_wall, max(depth, 0.0), contact),
    ):
        assert verdict.number == pytest.approx(number, abs=CLOSE), verdict.matter
        if abs(number - limit) > CLOSE:
            good = YES if model == "elastic" else NOT_CHECKED
            assert verdict.word == (NO if number > limit else good), verdict.matter
    assert plan.verdicts.holds.word == NOT_CHECKED


limits = st.floats(0.0, 8.0)


@settings(max_examples=20)
@given(seed=st.integers(0, 2**31), arrival=limits, error=limits, contact=limits)
def test_verdicts_equal_a_direct_computation(seed, arrival, error, contact):
    check(seed, arrival, error, contact)


@pytest.mark.slow
@settings(max_examples=300)
@given(seed=st.integers(0, 2**31), arrival=limits, error=limits, contact=limits)
def test_verdicts_of_300_random_plans_equal_a_direct_computation(seed, arrival, error, contact):
    check(seed, arrival, error, contact)
