"""The model that plans are made on where none is named: the elastic one, but for two stages and comparisons."""

import inspect
import types
from pathlib import Path

import numpy as np
import pytest
from learn import main as learn_command
from methods.comparison import VARIANTS, parse_variant
from reference import REFERENCE_METHODS

from ctr_nlp import (
    Limits,
    Problem,
    Robot,
    Steerer,
    Study,
    growing,
    plan_through,
    solve_horizon,
    solve_per_frame,
    solve_robust,
    solve_robust_per_frame,
    table_i_robot,
)
from ctr_nlp.cli import plan_options
from ctr_nlp.cli.commands.plan import plan, steer
from ctr_nlp.cli.exchange.configurations import main as import_command
from ctr_nlp.cli.steering.live import main as live_command
from ctr_nlp.exceptions import OptionError, ProblemError
from ctr_nlp.models import DEFAULT_MODEL
from ctr_nlp.ocp import FORMULATIONS, default_model
from ctr_nlp.paths.curve import curve_from_points
from ctr_nlp.planning.horizon import Horizon
from ctr_nlp.planning.nlp_frames import NlpFrames
from ctr_nlp.studies import pareto_front
from ctr_nlp.tube_design.co_design import design
from ctr_nlp.view.live import Live
from ctr_nlp.view.live.steered.session import Session

TWO_STAGE = ["two-stage", "two-stage-exact"]
ENTRIES = [
    solve_horizon,
    Horizon,
    Steerer,
    Steerer.create_if_compiled,
    plan_through,
    Live,
    Session,
    solve_robust,
    solve_robust_per_frame,
    design,
]


@pytest.fixture
def problem():
    """Two tubes and three frames along a straight path."""
    path = curve_from_points(np.outer(np.linspace(0, 80, 20), [0, 0, 1.0]))
    return Problem("straight", Robot(table_i_robot().tubes[:2]), growing(path, 3))


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.__qualname__)
def test_every_entry_point_takes_the_elastic_model(entry):
    assert inspect.signature(entry).parameters["model"].default == DEFAULT_MODEL == "elastic"


@pytest.mark.interpreted
def test_joint_frames_are_elastic_and_two_stages_dominant(problem):
    models = {name: NlpFrames.of(problem, name).model.name for name in FORMULATIONS}
    assert models == {"joint": "elastic", "two-stage": "dominant", "two-stage-exact": "dominant"}
    assert default_model("horizon") == "elastic"


@pytest.mark.interpreted
def test_plans_tell_the_default_model(problem):
    found = solve_per_frame(problem, "two-stage", direction="forward")
    assert found.meta["model"] == "dominant"
    q = np.array([[0, 0, 1, 20, 0, 0.0], [0, 0, 1, 40, 0, 0], [0, 0, 1, 70, 0, 0]])
    assert plan_through(problem, q).meta["model"] == "elastic"


@pytest.mark.parametrize("formulation", TWO_STAGE)
def test_two_stages_refuse_the_elastic_model_by_name(problem, formulation, tmp_path, capsys):
    message = "model is 'elastic'; two-stage formulations need 'dominant'"
    with pytest.raises(OptionError, match=message):
        solve_per_frame(problem, formulation, model="elastic")
    asked = ["arc", "--formulation", formulation, "--model", "elastic", "--out", str(tmp_path / "out")]
    assert steer(asked) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", [plan, steer], ids=["plan", "steer"])
@pytest.mark.parametrize(
    ("options", "model"),
    [
        ([], "elastic"),
        (["--formulation", "joint"], "elastic"),
        (["--robust"], "elastic"),
        (["--model", "dominant", "--robust"], "dominant"),
        *((["--formulation", name], "dominant") for name in TWO_STAGE),
    ],
)
def test_commands_plan_on_the_default_of_their_formulation(command, options, model):
    arguments = command.parser("ctr-nlp").parse_args(["arc", *options])
    assert plan_options.model_from(arguments) == model


def test_commands_that_move_robots_are_elastic_and_learning_is_not():
    assert live_command.parser("live").parse_args([]).model == "elastic"
    assert import_command.parser("import").parse_args(["q.csv", "--problem", "arc"]).model == "elastic"
    assert learn_command.parser("learn").parse_args([]).model == "dominant"


def test_variants_without_a_model_stay_dominant():
    ours = [name for name in VARIANTS if name not in REFERENCE_METHODS]
    assert len(ours) > 4
    assert {parse_variant(name).model for name in ours} == {"dominant"}
    assert parse_variant("horizon:ipopt:elastic").model == "elastic"


def test_studies_take_the_default_of_each_method():
    told = {"problems": {"names": ["arc"]}, "frames": 4, "methods": ["horizon", "joint", "two-stage"]}
    models = {case.method: case.model for case in Study.from_dict(told, Path()).cases}
    assert models == {"horizon": "elastic", "joint": "elastic", "two-stage": "dominant"}


@pytest.mark.interpreted
def test_elastic_ends_too_far_apart_are_refused(problem):
    robot = Robot(problem.robot.tubes, Limits(alpha_speed=1.0))
    ends = {"start": [0.0, 0, 0, 1, 0, 0], "end": [40.0, 0, 50, 80, 0, 0]}
    slow = Problem("slow", robot, problem.target)
    with pytest.raises(ProblemError, match=r"speed of alpha_1 would have to be 4\.00 times what is allowed"):
        Horizon(slow, **ends)


def test_methods_beside_a_front_are_judged_on_its_model(problem, monkeypatch):
    """The error of a motion planned on the dominant model is that of the elastic robot moved through it."""
    q = np.array([[0, 1.5, 1, 20, 0, 0.0], [0, 1.5, 20, 50, 0, 0], [0, 1.5, 40, 80, 0, 0]])
    ours, other = (plan_through(problem, q, model) for model in ("elastic", "dominant"))
    horizon = types.SimpleNamespace(problem=problem, solve=lambda *_, **__: ours)
    variant = types.SimpleNamespace(model="dominant", plan=lambda *_: other)
    monkeypatch.setattr(pareto_front, "COMPARED_VARIANTS", ("other",))
    monkeypatch.setattr(pareto_front, "parse_solver_variant", lambda _: variant)
    monkeypatch.setattr(
        pareto_front, "_point", lambda method, plan: types.SimpleNamespace(method=method, shape=plan.shape)
    )
    front, beside = pareto_front.compute_pareto_front(horizon, ours, (1e-5,), None, lambda label: None)
    np.testing.assert_allclose(beside.shape, front.shape, atol=1e-9)
    assert np.abs(other.shape - ours.shape).max() > 0.1
