"""A model and a term that are written here alone, with one line of registration, do all that ours do."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass

import casadi as ca
import matplotlib
import numpy as np
import pytest

from ctr_nlp import (
    Limits,
    Plan,
    Problem,
    Robot,
    Tube,
    curve_from_formula,
    growing,
    solve_horizon,
    solve_per_frame,
    table_i_robot,
)
from ctr_nlp.cli.commands.export import main
from ctr_nlp.exceptions import OptionError
from ctr_nlp.hardware.description import simulated_hardware
from ctr_nlp.models import KINEMATIC_MODELS, Model, SymbolicShape, register
from ctr_nlp.models.inner import Inner
from ctr_nlp.ocp.nlp import Residual
from ctr_nlp.ocp.terms import Parts, Term
from ctr_nlp.plan.metrics import by_frame, summary
from ctr_nlp.view.figures import save_all

matplotlib.use("Agg")
ROBOT = Robot((Tube(200, 150, 0.008, 2, 1),), Limits(alpha=(-1.5, 1.5)))


class Bending(Model):
    """One tube whose motor bends it, in the plane y = 0 of its base: its curvature is k (1 + 0.9 sin alpha)."""

    name = "bending"

    def check(self, robot):
        if robot.d != 1:
            raise OptionError(f"model is 'bending', and the robot has {robot.d} tubes; it describes one")

    def frame(self, structure, tubes, sample_lengths, margin=None, tangents=False):
        x = ca.SX.sym("q", 4)
        alpha, beta, theta_x, theta_y = ca.vertsplit(x)
        s, k = sample_lengths([beta]), tubes[0].tip_curvature * (1 + 0.9 * ca.sin(alpha))
        local = (1 - ca.cos(k * s)) / k, 0 * s, ca.sin(k * s) / k
        along = ca.sin(k * s), 0 * s, ca.cos(k * s)
        points, directions = (turned(vectors, theta_x, theta_y) for vectors in (local, along))
        return SymbolicShape(x, alpha, (beta,), points, Inner(), directions if tangents else None)


@dataclass(frozen=True)
class OnTheLeft(Term):
    """The tip is drawn to x = 0, at a weight."""

    weight: float
    name = "left"

    def sample_arc_lengths(self, beta):
        return beta[-1]

    def build(self, body, parameters):
        return Parts(residuals=(Residual("left", math.sqrt(self.weight) * body.points[0]),))


register(Bending())


def turned(vectors, theta_x, theta_y):
    """Vectors of the base's own axes, by R = Ry(theta_y) Rx(theta_x)."""
    x, y, z = vectors
    y, z = ca.cos(theta_x) * y - ca.sin(theta_x) * z, ca.sin(theta_x) * y + ca.cos(theta_x) * z
    return ca.cos(theta_y) * x + ca.sin(theta_y) * z, y, -ca.sin(theta_y) * x + ca.cos(theta_y) * z


@pytest.fixture(scope="module")
def problem():
    """A circle of radius 100 mm towards +x, which the tube can bend into exactly."""
    path = curve_from_formula(lambda u: (100 - 100 * ca.cos(u), 0, 100 * ca.sin(u)), 0.0, 1.2)
    return Problem("circle", ROBOT, growing(path, 8))


@pytest.mark.parametrize("solver", ["sqp", "ipopt"])
def test_frames_are_planned_on_it(problem, solver):
    plan = solve_per_frame(problem, model="bending", solver=solver)
    assert plan.complete
    assert summary(plan)["e3"] < 1e-3
    np.testing.assert_allclose(0.008 * (1 + 0.9 * np.sin(plan.alpha[3:])), 0.01, rtol=1e-3)


@pytest.mark.parametrize("solver", ["banded", "ipopt"])
def test_a_whole_motion_is_planned_on_it(problem, solver):
    plan = solve_horizon(problem, model="bending", solver=solver)
    assert plan.complete
    assert summary(plan)["e3"] < 0.05


def test_its_plans_have_errors_figures_verdicts_and_a_file(problem, tmp_path):
    plan = solve_per_frame(problem, model="bending")
    plan.save(tmp_path / "plan.npz")
    again = Plan.load(tmp_path / "plan.npz")
    assert (again.evaluated_model_name, summary(again)["model"]) == ("bending", "bending")
    np.testing.assert_allclose(
        by_frame(again)["max"], np.linalg.norm(plan.shape - plan.target, axis=-1).max(axis=1)
    )
    assert not again.verdicts.failed_names
    assert again.verdicts.stable.word == "NOT CHECKED"
    pictures = save_all(again, tmp_path)
    assert pictures
    assert all(path.stat().st_size > 1000 for path in pictures)


def test_its_plans_are_exported(problem, tmp_path):
    """As a table and as G-code, which end where the plan does."""
    pytest.importorskip("toppra", reason='needs toppra: pip install -e ".[hardware]"')
    plan = solve_per_frame(problem, model="bending")
    plan.save(tmp_path / "plan.npz")
    assert main([str(tmp_path / "plan.npz"), "--to", "csv"]) == 0
    with (tmp_path / "plan.csv").open(newline="") as file:
        last = {name.rpartition("_")[0]: float(value) for name, value in list(csv.DictReader(file))[-1].items()}
    joints = dict(zip(plan.robot.axes, plan.q[-1], strict=True))
    for axis in simulated_hardware(ROBOT).axes:
        assert last[axis.joint] == pytest.approx(joints[axis.joint], abs=1e-6)
        assert last[axis.letter] == pytest.approx(axis.zero + axis.scale * joints[axis.joint], abs=1e-3)
    assert main([str(tmp_path / "plan.npz"), "--to", "gcode"]) == 0
    assert "X" in (tmp_path / "plan.gcode").read_text()


@pytest.mark.parametrize("solve", [solve_per_frame, solve_horizon])
@pytest.mark.parametrize("model", ["bending", "dominant"])
def test_a_term_of_ones_own_draws_where_it_says(problem, solve, model):
    """A heavier one draws further, and the shape pays."""
    plans = [solve(problem, model=model, terms=terms) for terms in ((), (OnTheLeft(0.3),), (OnTheLeft(3.0),))]
    tips = [abs(plan.shape[-1, -1, 0]) for plan in plans]
    assert all(plan.complete for plan in plans)
    assert tips[2] < tips[1] < tips[0] - 1
    assert summary(plans[2])["e3"] > summary(plans[0])["e3"]
    assert plans[1].options["terms"] == ["OnTheLeft(weight=0.3)"]


def test_a_term_of_ones_own_draws_on_the_elastic_model_too(problem, monkeypatch):
    """Interpreted: every other weight is another program."""
    monkeypatch.setenv("CTR_NLP_COMPILE", "0")
    whole = table_i_robot()
    two = Problem("circle", Robot(whole.tubes[1:]), growing(problem.target.curves[0], 3))
    plans = [solve_per_frame(two, model="elastic", terms=terms) for terms in ((), (OnTheLeft(3.0),))]
    assert all(plan.complete for plan in plans)
    assert abs(plans[1].shape[-1, -1, 0]) < abs(plans[0].shape[-1, -1, 0]) - 1


def test_a_name_belongs_to_one_model():
    class Other(Bending):
        """Another of the same name."""

    with pytest.raises(OptionError, match="name of a model is 'bending'"):
        register(Other())
    with pytest.raises(OptionError, match="must be a Model"):
        register("bending")
    assert list(KINEMATIC_MODELS)[:2] == ["dominant", "elastic"]
