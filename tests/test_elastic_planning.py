"""Planning on the elastic model: a frame's functions and what its constraints say, and the motions found with them."""

from __future__ import annotations

import csv
import functools
import json
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import truth
from problems import FOLDER, named
from rows import central

from ctr_nlp import (
    Problem,
    Robot,
    Settings,
    Tube,
    branches,
    curve_from_formula,
    growing,
    seed_robot,
    solve_horizon,
    solve_per_frame,
    summary,
    tracking,
)
from ctr_nlp.cli.solve_horizon import main as solve_horizon_program
from ctr_nlp.cli.solve_per_frame import main as solve_per_frame_program
from ctr_nlp.errors import OptionError
from ctr_nlp.formulations import FORMULATIONS
from ctr_nlp.formulations.joint import alone
from ctr_nlp.models import stability, torsion
from ctr_nlp.models.symbolic import STEPS
from ctr_nlp.plan import Plan
from ctr_nlp.reference import METHODS
from ctr_nlp.reference.published import SEED_ELASTIC
from ctr_nlp.solvers import compiled
from ctr_nlp.steer.nlp_frames import NlpFrames
from ctr_nlp.study import parse_variant, variants_here
from ctr_nlp.terms import CLEAR

MARGIN = 0.1
ROBOTS = {
    "seed": seed_robot(),
    "varying curvature": Robot(truth.TWO.tubes),
    "pushed out": truth.TWO,
}
EVERY_ROBOT = pytest.mark.parametrize("kind", ROBOTS)
TIES = {
    "seed": [(30, 30, 110), (0, 40, 90), (20, 80, 80), (0, 0, 60)],
    "varying curvature": [(30, 30), (0, 50)],
    "pushed out": [(40, 40), (0, 90), (45, 80), (60, 105)],
}
"""Extensions at which sections vanish."""


@functools.cache
def frame(kind):
    """A frame with the margin as a parameter, and its functions."""
    nlp = alone(ROBOTS[kind], "elastic", True)
    return nlp, nlp.functions


def packed(nlp, seed, margin=MARGIN):
    """A target like a helix, with noise."""
    u = np.linspace(0, 1, nlp.parameters["target"].shape[0])
    target = np.stack([25 * np.sin(2 * u), 15 * u**2, 90 * u], axis=1)
    return nlp.pack({"target": target + np.random.default_rng(seed).normal(size=target.shape), "margin": margin})


def drawn(robot, seed, count=1):
    """Unknowns (count, 2d + 2) at which tubes are turned by up to half a turn; extensions apart and in order."""
    rng, d = np.random.default_rng(seed), robot.d
    x = np.concatenate([rng.uniform(-3.1, 3.1, (count, d)), np.zeros((count, d)), rng.uniform(-0.5, 0.5, (count, 2))], 1)
    parts = np.sort(rng.uniform(0.15, 0.97, (count, d)), axis=1)
    x[:, d : 2 * d] = np.maximum.accumulate(parts * robot.upper[d : 2 * d], axis=1) + 0.37 * np.arange(d)
    return x


def assert_first_derivatives(kind, x, seed):
    nlp, functions = frame(kind)
    p = packed(nlp, seed)

    def both(at):
        f, g = functions.value(at, p)
        return np.append(float(f), g.full().ravel())

    _, gradient, _, jacobian = functions.slopes(x, p)
    exact, found = np.vstack([gradient.full().ravel(), jacobian.full()]), central(both, x, 1e-6)
    np.testing.assert_allclose(exact, found, rtol=1e-5, atol=1e-6 * np.abs(found).max(axis=1, keepdims=True).max())


# A frame's functions


@EVERY_ROBOT
@pytest.mark.parametrize("seed", range(3))
def test_first_derivatives_match_finite_differences(kind, seed):
    """Of the objective, motors' angles, determinants and order."""
    assert_first_derivatives(kind, drawn(ROBOTS[kind], seed)[0], seed)


@pytest.mark.parametrize(("kind", "beta"), [(kind, beta) for kind, some in TIES.items() for beta in some])
def test_first_derivatives_match_where_sections_vanish(kind, beta):
    robot = ROBOTS[kind]
    x = drawn(robot, 5)[0]
    x[robot.d : 2 * robot.d] = beta
    assert_first_derivatives(kind, x, 5)


@EVERY_ROBOT
@pytest.mark.parametrize("seed", range(3))
def test_hessians_match_finite_differences_of_slopes(kind, seed):
    nlp, functions = frame(kind)
    rng, x, p = np.random.default_rng(seed), drawn(ROBOTS[kind], seed)[0], packed(nlp, seed)
    lam_f, lam_g = rng.uniform(0.5, 2), 100 * rng.normal(size=nlp.g.numel())

    def gradient(at):
        _, slope, _, jacobian = functions.slopes(at, p)
        return lam_f * slope.full().ravel() + jacobian.full().T @ lam_g

    *slopes, hessian = (part.full() for part in functions.expansion(x, p, lam_f, lam_g))
    found = central(gradient, x, 1e-6)
    np.testing.assert_allclose(hessian, found, rtol=1e-5, atol=1e-6 * np.abs(found).max())
    for one, other in zip(slopes, functions.slopes(x, p), strict=True):
        np.testing.assert_allclose(one, other.full(), rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("lanes", [1, 8])
def test_compiled_code_is_what_is_interpreted(lanes):
    """Of the libraries that solvers of frames and of horizons use."""
    robot = ROBOTS["seed"]
    joint = FORMULATIONS["joint"](robot, Settings(), "elastic")[0].nlp
    nlp = joint if lanes == 1 else frame("seed")[0]
    x, rng = drawn(robot, 1, lanes), np.random.default_rng(1)
    known = {"target": rng.normal(size=(21, 3)), "margin": MARGIN, "previous": rng.normal(size=8), "motion_root": 0.1}
    p = nlp.pack({name: known[name] for name in nlp.parameters})
    inputs = [x.T, np.tile(p, (lanes, 1)).T, np.ones((1, lanes)), rng.normal(size=(nlp.g.numel(), lanes))]
    functions, fast = nlp.functions, compiled.compiled(nlp, lanes)
    for name in ("value", "slopes", "expansion"):
        function = getattr(functions, name)
        given = inputs[: function.n_in()]
        expected = [part.full() for part in function.map(lanes).call([ca.DM(each) for each in given])]
        blocks = [ca.DM(each) if lanes == 1 else ca.DM(each.ravel(order="F")) for each in given]
        found = getattr(fast, name).call([ca.reshape(b, *getattr(fast, name).size_in(i)) for i, b in enumerate(blocks)])
        for one, other in zip(found, expected, strict=True):
            scale = np.abs(other).max()
            np.testing.assert_allclose(one.full().ravel("F"), other.ravel("F"), rtol=1e-9, atol=1e-11 * scale)


# What constraints say


def constraints(kind, x, margin=MARGIN):
    """Values of a frame's constraints by name, and which of the determinants are allowed (T,)."""
    nlp, functions = frame(kind)
    p = packed(nlp, 0, margin)
    g = functions.value.map(len(x))(x.T, np.tile(p, (len(x), 1)).T)[1].full().T
    sizes = np.cumsum([constraint.value.numel() for constraint in nlp.constraints])[:-1]
    return dict(zip((constraint.name for constraint in nlp.constraints), np.split(g, sizes, axis=1), strict=True))


@EVERY_ROBOT
def test_alpha_is_that_of_the_configuration(kind):
    """To rounding with the steps that a nonlinear program takes; with those of forward solutions, to 0.01 rad
    where a robot is stable.
    """
    robot = ROBOTS[kind]
    x = drawn(robot, 2, 100)
    alpha, d = constraints(kind, x)["alpha"], robot.d
    columns = [column[:, None] for column in x.T]
    twisted = torsion.twist(robot, columns, torsion.sections(robot, columns[d : 2 * d], np), np, STEPS)
    np.testing.assert_allclose(alpha, np.hstack(torsion.motors(robot, columns, twisted)), rtol=1e-12, atol=1e-12)
    stable = stability.margins(robot, x) > MARGIN
    np.testing.assert_allclose(alpha[stable], tracking.configuration(robot, x)[stable, :d], atol=0.01)


@pytest.mark.parametrize("margin", [0.0, 0.1, 0.5])
@EVERY_ROBOT
def test_determinants_are_allowed_where_the_margin_is_held(kind, margin):
    """But for 0.03 about the margin, by which integration and Galerkin's method differ. A determinant before the last
    keeps CLEAR from 0, so that it may forbid a little more than the margin does.
    """
    robot = ROBOTS[kind]
    x = drawn(robot, 3, 600)
    margins, determinants = stability.margins(robot, x), constraints(kind, x, margin)["stability"]
    held, missed = margins > margin + 0.03, margins < margin - 0.03
    assert min(held.sum(), missed.sum()) > 50
    assert (determinants[held] > 0).all()
    allowed = (determinants >= np.append(np.full(determinants.shape[1] - 1, CLEAR), 0)).all(axis=1)
    assert not (allowed & missed).any()
