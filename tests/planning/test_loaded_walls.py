"""Robots that bear a load within a lumen: frame by frame, and step by step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from common import named_problem
from lumens import bent

from ctr_nlp import Load, Loaded, Problem, Settings, Steerer, growing, solve_per_frame, table_i_robot
from ctr_nlp.models.loads import with_modulus
from ctr_nlp.plan.measures import e3

NITINOL = with_modulus(table_i_robot(), 60_000)
PULL = Load(force=(0.1, -0.2, 0.15))


@pytest.mark.parametrize("force", [(0.0, 0.1, 0.0), pytest.param((-0.1, 0.0, 0.0), marks=pytest.mark.slow)])
def test_a_robot_is_kept_within_its_lumen_frame_by_frame_though_the_load_is_taken_away_at_the_end(force):
    """This load makes the last frame more stable than it is without. The run begins there, and goes backwards."""
    problem = named_problem("bronchus", 20)
    problem = replace(problem, robot=NITINOL)
    plan = solve_per_frame(problem, model=Loaded(Load(force=force)))
    assert plan.options["direction"] == "backward"
    assert plan.complete
    assert not plan.meta["snaps"]
    assert plan.clearance.min() > 0
    assert e3(plan) < 1.1 * e3(solve_per_frame(replace(problem, lumen=None), model=Loaded(Load(force=force))))


@pytest.mark.slow
def test_steps_under_a_load_within_a_lumen_give_the_frames_of_a_plan():
    """Without a margin, which a plan raises where it is missed between frames."""
    lumen, settings, model = bent(3.6), Settings(arrival_weight=0.0, stability_margin=None), Loaded(PULL)
    problem = Problem("bent", NITINOL, growing(lumen.part(0.0, 110.0), 12), lumen=lumen)
    told = {"settings": settings, "model": model}
    first = solve_per_frame(problem, direction="forward", **told).q[0]
    plan = solve_per_frame(problem, solver="sqp", direction="forward", start=first, **told)
    steerer = Steerer(NITINOL, first, problem.dt, lumen=lumen, **told)
    free = Steerer(NITINOL, first, problem.dt, **told)
    motion, alone = (np.array([each.step(f.points) for f in problem.target_frames]) for each in (steerer, free))
    np.testing.assert_allclose(motion, plan.q, atol=1e-3)
    assert steerer.is_solved
    assert abs(alone - motion).max() > 0.1
