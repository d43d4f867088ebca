"""The methods to compare with do what they are said to do."""

import numpy as np
import pytest
from common import named_problem
from hypothesis import given
from hypothesis import strategies as st
from methods.comparison import VARIANTS, compare, parse_variant
from reference import reference_frames
from reference.descent import descend, extensions, fractions
from strategies import configurations, robots

from ctr_nlp import Settings, summary
from ctr_nlp.exceptions import OptionError
from ctr_nlp.planning.per_frame import march


def run(name, method):
    problem = named_problem(name, 20)
    return march(problem, reference_frames(problem, method, Settings()), "forward")


@given(st.data())
def test_extensions_and_fractions_are_inverse(data):
    robot = data.draw(robots(least=2))
    beta = robot.split(data.draw(configurations(robot)))[1]
    assert extensions(robot, fractions(robot, beta)) == pytest.approx(beta, abs=1e-9)


@given(st.data())
def test_any_fractions_keep_limits_and_order(data):
    robot = data.draw(robots(least=2))
    beta = extensions(robot, np.array([data.draw(st.floats(0, 1)) for _ in range(robot.d)]))
    robot.check(np.concatenate([np.zeros(robot.d), beta, np.zeros(2)]))


def test_descent_finds_a_bounded_minimum():
    """min (x - 2)^2 + 3 (y + 1)^2 on [0, 1] x [0, 1] lies at (1, 0)."""
    x, cost, success, _, _ = descend(
        lambda batch: (batch[:, 0] - 2) ** 2 + 3 * (batch[:, 1] + 1) ** 2,
        np.array([0.5, 0.5]),
        np.tile([0.0, 1.0], (2, 1)),
    )
    assert success
    assert x == pytest.approx([1, 0])
    assert cost == pytest.approx(4)


@pytest.mark.parametrize("method", ["paper-two-stage", "euclidean"])
def test_descent_methods_recover_synthetic_shapes(method):
    assert summary(run("synthesis", method))["e3"] < 0.3


def test_tip_control_moves_the_tip_and_not_the_shape():
    found = summary(run("bronchus", "tip-jacobian"))
    assert found["failed"] == 0
    assert found["tip_max"] < 0.1
    assert found["e3"] > 2


@pytest.mark.slow
def test_every_variant_keeps_position_limits():
    problem = named_problem("arc", 4)
    for row_variant in VARIANTS:
        plan = parse_variant(row_variant).plan(problem, Settings(), (), None)
        robot = plan.robot
        assert (plan.q >= robot.lower - 1e-6).all()
        assert (plan.q <= robot.upper + 1e-6).all()
        assert (np.diff(plan.beta, axis=1) >= -1e-6).all()


def test_comparison_puts_published_figures_beside():
    rows = compare([named_problem("arc", 3)], [parse_variant("joint:ipopt"), parse_variant("euclidean")]).rows
    assert [row["seed_e3"] for row in rows] == [1.62, 1.81]
    assert all(row["failed"] == 0 and row["e3"] < 3 for row in rows)


@pytest.mark.parametrize("name", ["joint", "joint:snopt", "joint:ipopt:rigid", "jiont:ipopt", "a:b:c:d", ""])
def test_unknown_variants_are_refused(name):
    with pytest.raises(OptionError, match="must be one of"):
        parse_variant(name)
