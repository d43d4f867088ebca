"""Plans whose later frames are planned anew."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from ctr_nlp import Curve, Problem, Target, curve_from_formula, growing, solve_per_frame, table_i_robot


def arc(radius: float) -> Curve:
    return curve_from_formula(
        lambda u: (radius * ca.cos(u / radius) - radius, 0.0, radius * ca.sin(u / radius)), 0.0, 90.0
    )


FIRST, OTHER = arc(120.0), arc(80.0)


@pytest.fixture(scope="module")
def problem() -> Problem:
    return Problem("arc", table_i_robot(), growing(FIRST, 6))


@pytest.fixture(scope="module")
def plan(problem):
    return solve_per_frame(problem, model="dominant", direction="forward")


def test_later_frames_are_replanned_from_the_last_kept_one(plan, problem):
    other = growing(OTHER, 6)
    changed = replace(
        problem, target=Target((FIRST,) * 3 + (OTHER,) * 3, problem.target.lengths[:3] + other.lengths[3:])
    )
    rest = solve_per_frame(changed[3:], start=plan.q[2], model="dominant", direction="forward")
    found = plan[:3] + rest
    np.testing.assert_array_equal(found.q[:3], plan.q[:3])
    np.testing.assert_array_equal(found.target, [frame.points for frame in changed.target_frames])
    assert found.complete
    assert np.linalg.norm(found.shape[3:] - found.target[3:], axis=-1).max() < 5
    steps = np.abs(np.diff(found.q, axis=0))
    assert (steps <= plan.robot.speed * plan.dt + 1e-6).all()
    assert found.meta["joined"]["frames"] == [3, 3]
