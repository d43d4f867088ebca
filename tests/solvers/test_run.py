"""Frames of one problem, each solved from the one before it: where they are begun."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest

from ctr_nlp.ocp.nlp import Constraint, CostTerm, Nlp
from ctr_nlp.solvers.frame.adapter import KKT_TOLERANCE
from ctr_nlp.solvers.frame.program import Program
from ctr_nlp.solvers.frame.run import FrameSequence

FRAMES = 12


def problem(*constraints):
    """Two unknowns that are best where the parameter `to` (2, 1) is, in valleys that no quadratic has."""
    x, to = ca.SX.sym("x", 2), ca.SX.sym("to", 2)
    valley = CostTerm("valley", ca.sum1((x - to) ** 2 + (x - to) ** 4))
    made = tuple(constraint(x) for constraint in constraints)
    return Nlp("valley", x, np.full(2, -99.0), np.full(2, 99.0), {"to": to}, (), (valley,), made)


def beside_one(x):
    """The first unknown is not within half of 1; between, where the slope vanishes, no step leads out."""
    return Constraint("gap", (x[0] - 1) ** 2, np.array([0.25]), np.array([math.inf]))


def followed(nlp, targets, start, goes_on=True, most=60):
    """The run after it solved the targets (T, 2) in turn, from a start (2,) at rest."""
    run = FrameSequence(Program(nlp, True, most), len(targets), KKT_TOLERANCE, goes_on)
    run.p[:] = [nlp.pack({"to": target}) for target in targets]
    run.low[:], run.high[:], run.most[:] = -99.0, 99.0, math.inf
    run.set_start(np.array(start, float), np.array(start, float))
    run(len(targets))
    return run


def along(*powers):
    """Targets of which each coordinate moves as a power of the time."""
    time = np.arange(FRAMES, dtype=float)
    return np.column_stack([0.5 * time**power for power in powers])


@pytest.mark.parametrize(("powers", "known"), [((1, 1), 2), ((2, 2), 4), ((1, 2), 4)])
def test_a_steady_or_evenly_changing_motion_needs_an_iteration_a_frame_once_it_is_known(powers, known):
    run = followed(problem(), along(*powers), (0, 0))
    assert run.solved.all()
    assert (run.iterations[known:] <= 1).all()
    assert (run.iterations[1:known] > 1).all()


@pytest.mark.parametrize("powers", [(1, 1), (2, 2), (1, 2), (3, 2)])
def test_frames_are_the_same_wherever_they_are_begun(powers):
    targets = along(*powers)
    on, here = followed(problem(), targets, (0, 0)), followed(problem(), targets, (0, 0), goes_on=False)
    np.testing.assert_allclose(on.x, here.x, atol=1e-6)
    assert on.iterations.sum() < here.iterations.sum()


def test_an_unknown_that_trembles_is_not_expected_to_tremble_on():
    """Where changes of the movement alternate, the movement itself tells the next one better than its change."""
    targets = along(1, 1) + 0.4 * (-1.0) ** np.arange(FRAMES)[:, None]
    trembling, here = followed(problem(), targets, (0, 0)), followed(problem(), targets, (0, 0), goes_on=False)
    assert trembling.solved.all()
    assert trembling.iterations.sum() <= here.iterations.sum()


def test_a_motion_that_turns_back_is_begun_where_it_is():
    """The place to which it would have gone on is worse than the one where it is."""
    there = along(1, 1)
    run = followed(problem(), np.vstack([there, there[::-1]]), (0, 0))
    assert run.solved.all()
    assert run.iterations[FRAMES] == 0
    np.testing.assert_allclose(run.x[-1], 0, atol=1e-6)


JUMP = np.array([[-3.0, 0], [-1.0, 0], [1.1, 0]])
"""Where the first unknown would go on to 1 in the last frame, which is nearer to its target but in the gap."""


def test_where_going_on_leads_to_no_solution_a_frame_is_begun_where_the_one_before_ended():
    nlp = problem(beside_one)
    on, here = followed(nlp, JUMP, JUMP[0]), followed(nlp, JUMP, JUMP[0], goes_on=False)
    assert here.solved.all()
    assert on.solved.all()
    np.testing.assert_allclose(on.x[-1], [0.5, 0], atol=1e-6)


def kinked():
    """One unknown that is drawn to `to[0]`, or, where to[1] is 1, to a kink at 1 or to a smooth valley at -1."""
    x, to = ca.SX.sym("x"), ca.SX.sym("to", 2)
    kink = ca.if_else(x > 0, 10 * ca.fabs(x - 1), 2 + (x + 1) ** 2 + (x + 1) ** 4)
    cost = CostTerm("kinked", (1 - to[1]) * (x - to[0]) ** 2 + to[1] * kink)
    return Nlp("kinked", x, np.array([-99.0]), np.array([99.0]), {"to": to}, (), (cost,), ())


TO_THE_KINK = np.array([[-1.9, 0.0], [-0.5, 0.0], [0.0, 1.0]])
"""Where the unknown would go on to 0.9 in the last frame, from where every way ends at the kink."""


def test_both_attempts_have_the_iterations_that_are_allowed_together():
    whole, here = (followed(kinked(), TO_THE_KINK, TO_THE_KINK[0, :1], goes_on) for goes_on in (True, False))
    assert whole.solved.all()
    assert here.solved.all()
    np.testing.assert_allclose(whole.x[:, 0], [-1.9, -0.5, -1.0], atol=1e-6)
    spent = int(whole.iterations[-1] - here.iterations[-1])
    assert spent > 1
    short = followed(kinked(), TO_THE_KINK, TO_THE_KINK[0, :1], most=spent + 1)
    assert short.iterations[-1] == spent + 1
    assert not short.solved[-1]
