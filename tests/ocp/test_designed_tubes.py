"""Tubes as unknowns: they stand for the robot that is described, keep rules, and give frames the same numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from truth import TWO

from ctr_nlp import Limits, Robot, Tube, table_i_robot
from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.frame import program
from ctr_nlp.ocp.shared.design import (
    DESIGN_LENGTH_UNIT_MM,
    DESIGN_NUMBER_NAMES,
    DesignedTubes,
    with_linear_curvatures,
)
from ctr_nlp.ocp.shared.manufacture import Manufacture
from ctr_nlp.ocp.shared.tasks import CurvedPartLimit
from ctr_nlp.ocp.terms import ShapeDistance
from ctr_nlp.robot.strain import largest_strain
from ctr_nlp.robot.structure import locate_free_numbers

THIN = Manufacture(channel=0.3, wall=0.1)
TABLE, PAIR = table_i_robot(), Robot(TWO.tubes)


@pytest.mark.parametrize(
    "robot", [TABLE, PAIR, with_linear_curvatures(TABLE)], ids=["three arcs", "two", "varying"]
)
def test_unknowns_of_a_robot_give_the_robot(robot):
    tubes = DesignedTubes(robot, THIN)
    found = tubes.robot_of(tubes.nominal_unknowns)
    assert found.structure == robot.structure
    np.testing.assert_allclose(found.numbers, robot.numbers, rtol=1e-12)
    assert len(tubes.names) == len(tubes.nominal_unknowns) == len(tubes.box[0])


def test_frames_get_the_numbers_of_the_robot_of_p():
    tubes = DesignedTubes(TABLE, THIN)
    p = tubes.nominal_unknowns * np.linspace(0.9, 1.05, len(tubes.nominal_unknowns))
    made = tubes.robot_of(p)
    values = tubes.program.functions.value(p, tubes.program.pack({"near": p, "pull": 1.0}))
    g = values[1].full().ravel()
    for k, (i, columns) in enumerate(locate_free_numbers(TABLE.structure, DESIGN_NUMBER_NAMES)):
        for column in columns:
            assert g[k] == pytest.approx(made.numbers[i, column], rel=1e-12)
    assert float(values[0]) == 0.0


def test_a_program_of_freed_numbers_is_the_one_that_takes_them_as_parameters():
    model, terms = KINEMATIC_MODELS["elastic"], (ShapeDistance(), CurvedPartLimit())
    other = replace(
        TWO, tubes=tuple(replace(tube, outer_diameter=1.1 * tube.outer_diameter) for tube in TWO.tubes)
    )
    target = {"target": np.random.default_rng(3).normal(size=(21, 3)) * 20}
    x = np.array([0.4, -0.7, 30.0, 55.0, 0.1, 0.05])
    usual, freed = (
        program("frame", TWO.structure, model, terms),
        program("frame", TWO.structure, model, terms, DESIGN_NUMBER_NAMES),
    )
    values = {name: np.zeros(symbol.shape) for name, symbol in usual.parameters.items()} | target
    values = {name: np.resize(value, usual.parameters[name].shape) for name, value in values.items()}
    numbers = [
        other.numbers[i, columns[0]] for i, columns in locate_free_numbers(TWO.structure, DESIGN_NUMBER_NAMES)
    ]
    expected = usual.functions.value(x, usual.pack(values | {"tubes": other.numbers}))
    found = freed.functions.value(np.append(x, numbers), freed.pack(values | {"tubes": TWO.numbers}))
    for one, another in zip(found, expected, strict=True):
        np.testing.assert_allclose(one.full(), another.full(), rtol=1e-12, atol=1e-12)


def test_rules_of_both_ends_of_a_tube_have_names_of_their_own():
    tubes = DesignedTubes(with_linear_curvatures(TABLE), THIN)
    names = [rule.name for rule in tubes.rule_values(tubes.nominal_unknowns)]
    assert len(set(names)) == len(names)
    assert {"strain of tube 2 when made at its root", "strain of tube 2 when made at its tip"} <= set(names)


def test_rules_are_what_they_say_of_table_i():
    rules = {
        rule.name: rule
        for rule in DesignedTubes(TABLE, THIN).rule_values(DesignedTubes(TABLE, THIN).nominal_unknowns)
    }
    assert rules["strain of tube 2 when made"].value == pytest.approx(3.7 / 2 / 60)
    assert rules["wall of tube 1"].value == pytest.approx(0.7)
    assert rules["clearance of tubes 2 and 3"].value == pytest.approx(0.8)
    assert rules["inner channel"].value == pytest.approx(1.0)
    assert rules["room of the carriages of tubes 1 and 2"].value == pytest.approx(112.0)
    worst = largest_strain(TABLE.tubes, TABLE.max_extensions.tolist())
    deployed = [rule.value for name, rule in rules.items() if "within" in name]
    assert max(abs(value) for value in deployed) == pytest.approx(worst.strain, rel=1e-6)


def test_what_cannot_be_made_is_told_from_what_can():
    tubes = DesignedTubes(TABLE, replace(THIN, outer=5.7))
    assert tubes.satisfies_rules(tubes.nominal_unknowns)
    thin = tubes.nominal_unknowns.copy()
    thin[tubes.names.index("inner_diameter_2")] = 3.55
    assert not tubes.satisfies_rules(thin)
    bent = tubes.nominal_unknowns.copy()
    bent[tubes.names.index("curvature_1")] = DESIGN_LENGTH_UNIT_MM * 2 * 0.041 / 5.7
    assert not tubes.satisfies_rules(bent)


def test_fixed_numbers_have_one_value():
    tubes = DesignedTubes(TABLE, THIN, ("outer_diameter_1", "curved_length_2"))
    lower, upper = tubes.box
    held = [tubes.names.index(name) for name in tubes.fixed]
    np.testing.assert_array_equal(lower[held], tubes.nominal_unknowns[held])
    np.testing.assert_array_equal(upper[held], tubes.nominal_unknowns[held])


def test_a_name_that_no_number_has_is_refused():
    with pytest.raises(OptionError, match="'diameter_1' cannot be fixed; what can be is curvature_1"):
        DesignedTubes(TABLE, THIN, ("diameter_1",))


def test_rules_that_no_tubes_keep_are_refused():
    with pytest.raises(OptionError, match=r"at least 6\.1 mm thick, and outer of manufacture is 5\.7 mm"):
        DesignedTubes(TABLE, Manufacture(channel=5.0))


def test_transmissions_that_come_out_are_refused():
    out = Robot((Tube(90.0, 40.0, 0.01, 2.0, 1.0),), Limits(beta=((0.0, 50.0),)))
    with pytest.raises(OptionError, match="limits of beta let straight transmissions come out"):
        DesignedTubes(out, Manufacture())


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), "thin"])
def test_rules_are_positive_numbers(value):
    with pytest.raises(OptionError, match="wall of manufacture is"):
        Manufacture(wall=value)
