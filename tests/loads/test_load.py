"""Loads in real units, and what is refused with the unit that was likely meant."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from ctr_nlp import Load, Robot, table_i_robot
from ctr_nlp.exceptions import LoadError, RobotError
from ctr_nlp.models.loads import check_moduli, with_modulus

NITINOL = with_modulus(table_i_robot(), 60_000)


def of(modulus):
    return Robot(tuple(replace(tube, youngs_modulus=modulus) for tube in table_i_robot().tubes))


def test_the_weight_of_a_steel_rod_is_its_mass_times_g():
    """A metre of 2 mm steel wire weighs 24.7 g."""
    rod = Robot((replace(NITINOL.tubes[2], outer_diameter=2.0, inner_diameter=0.0),))
    numbers = Load(densities=7.85, down=(0, 0, -3)).numbers(1)
    np.testing.assert_allclose(numbers[:17], 0)
    np.testing.assert_allclose(numbers[17:] * rod.tubes[0].area * 1000, [0, 0, -0.02466 * 9.80665], rtol=1e-3)


def test_a_force_stands_in_the_axes_that_it_is_given_in():
    np.testing.assert_array_equal(Load(force=[0.1, 0, -0.2]).numbers(3)[:7], [0.1, 0, -0.2, 0, 0, 0, 0])
    np.testing.assert_array_equal(Load(moment=[1, 2, 3], axial_moment=4).numbers(3)[6:12], [1, 2, 3, 0, 0, 4])
    held = Load(force=np.array([0.1, 0, -0.2]), axes="tool", axial_moment=2)
    np.testing.assert_array_equal(held.numbers(3)[3:12], [0.1, 0, -0.2, 0, 0, 0, 0, 0, 2])
    turned = Load(moment=(1, 2, 3), axial_moment=4, axes="tool").numbers(3)
    np.testing.assert_array_equal(turned[6:12], [0, 0, 0, 1, 2, 7])


def test_a_force_along_the_body_has_its_places_beside_it():
    load = Load(distributed_force=[0, 0.002, 0], between=[20, 60])
    np.testing.assert_array_equal(load.numbers(3)[12:17], [0, 0.002, 0, 20, 60])
    assert load.conservative
    assert "(0, 0.002, 0) N/mm between 20 and 60 mm from the opening" in str(load)
    assert not Load(distributed_force=(0, 0, 0), between=(0, 5)).numbers(3).any()


def test_only_what_keeps_its_direction_has_an_energy():
    assert Load(force=(0, 0, 1), densities=6.45, down=(1, 0, 0)).conservative
    assert not Load(axial_moment=1.0).conservative
    assert not Load(moment=(0, 1.0, 0)).conservative
    assert not Load(force=(0, 0, 1), axes="tool").conservative


def test_a_load_is_the_same_after_a_file():
    load = Load((0.1, 0.2, 0.3), "tool", 4.0, (6.45, 6.45, 7.9), (0, 1, 0), (0, 0.001, 0), (20, 60), (1, 2, 3))
    assert Load.from_dict(load.to_dict()) == load
    assert hash(Load.from_dict(load.to_dict())) == hash(load)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"force": (0, math.nan, 0)}, r"force of a load has nan at \[2\]; all of it must be finite"),
        ({"force": (0, 0, 1e9)}, r"force of a load is 1e\+09 N; it must be at most 100 N; .*1 N \(1e\+09 nN\)"),
        ({"force": (0, 0, -200)}, r"force of a load is 200 N; it must be at most 100 N; .*0\.2 N \(200 mN\)"),
        ({"force": (1, 2)}, r"force of a load has shape \(2,\); it must be \(3,\)"),
        ({"force": "much"}, r"force of a load is 'much'; it must be numbers"),
        ({"axes": "world"}, r"axes of a load are 'world'; they must be base or tool"),
        ({"axial_moment": math.inf}, r"axial_moment of a load is inf N mm; it must be finite"),
        ({"axial_moment": -5000}, r"axial_moment of a load is -5000 N mm; it must be at most 1000 N mm; .*mN mm"),
        ({"moment": (0, 0, math.nan)}, r"moment of a load has nan at \[3\]; all of it must be finite"),
        ({"moment": 3}, r"moment of a load has shape \(\); it must be \(3,\)"),
        ({"moment": (0, 3000, 4000)}, r"^moment of a load is 5000 N mm; it must be at most 1000 N mm; .*5 N mm"),
        ({"distributed_force": (0, 0.1, 0)}, r"distributed_force of a load needs between"),
        ({"between": (0, 5)}, r"between of a load needs distributed_force"),
        (
            {"distributed_force": (0, 50, 0), "between": (0, 5)},
            r"50 N/mm; it must be at most 10 N/mm; .*\(50 N/m\)",
        ),
        (
            {"distributed_force": (0, 0.1, 0), "between": (9, 5)},
            r"between of a load is \[9, 5\] mm; it must be two",
        ),
        ({"densities": 6.45}, r"densities of a load needs down"),
        ({"down": (0, 0, 1)}, r"down of a load needs densities"),
        (
            {"densities": 6450, "down": (0, 0, 1)},
            r"is 6450 g/cm³; it must lie in \[0\.5, 25\].*6\.45 g/cm³ \(6450 kg",
        ),
        ({"densities": math.nan, "down": (0, 0, 1)}, r"densities of a load is nan g/cm³; it must lie in"),
        ({"densities": 6.45, "down": (0, 0, 0)}, r"down of a load is \(0, 0, 0\); it must be a direction"),
        ({"weight": 1.0}, r"key 'weight' is unknown in a load; allowed are force, axes"),
    ],
)
def test_what_no_robot_bears_is_refused_in_one_line(fields, message):
    with pytest.raises(LoadError, match=message) as caught:
        Load.from_dict(fields)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("modulus", "message"),
    [
        (1.0, r"youngs_modulus of tube 1 is 1; under a load it must be in MPa and lie in .*looks like a ratio"),
        (60.0, r"youngs_modulus of tube 1 is 60; .*did you mean 60000 MPa \(60 GPa\)\?"),
        (60e9, r"youngs_modulus of tube 1 is 6e\+10; .*did you mean 60000 MPa \(6e\+10 Pa\)\?"),
    ],
)
def test_a_robot_without_moduli_in_mpa_bears_no_load(modulus, message):
    with pytest.raises(LoadError, match=message):
        Load(force=(0, 0, 0.1)).check(of(modulus))
    if modulus > 1:
        with pytest.raises(LoadError, match=r"did you mean 60000 MPa"):
            with_modulus(table_i_robot(), modulus)


def test_a_modulus_that_is_no_number_is_refused_with_the_tube():
    with pytest.raises(RobotError, match=r"youngs_modulus is nan; it must be a finite number"):
        of(math.nan)
    with pytest.raises(LoadError, match=r"youngs_modulus of a robot is nan; it must be in MPa"):
        with_modulus(table_i_robot(), math.nan)


def test_densities_of_a_tube_that_does_not_exist_are_refused():
    with pytest.raises(LoadError, match=r"densities of a load has 4 numbers; .* each of the robot's 3 tubes"):
        Load(densities=(6, 6, 6, 6), down=(0, 0, 1)).numbers(3)


def test_a_robot_that_tells_its_moduli_needs_none_and_takes_its_own():
    """As of a designed robot, which a command line is repeated for."""
    first, *rest = with_modulus(table_i_robot(), 60_000).tubes
    robot = replace(table_i_robot(), tubes=(replace(first, youngs_modulus=75_000), *rest))
    assert with_modulus(robot, 60_000) == with_modulus(robot, 75_000) == robot
    told = "is given as 50000 MPa, but its tubes have moduli in MPa already, 75000, 60000, 60000; leave"
    with pytest.raises(LoadError, match=told):
        with_modulus(robot, 50_000)
    in_gpa = tuple(replace(tube, youngs_modulus=60) for tube in robot.tubes)
    with pytest.raises(LoadError, match=r"did you mean 60000 MPa \(60 GPa\)"):
        with_modulus(replace(robot, tubes=in_gpa), 60_000)


def test_ratios_between_tubes_stay_where_a_modulus_is_given():
    first, *others = table_i_robot().tubes
    found = with_modulus(Robot((replace(first, youngs_modulus=1.2), *others)), 50_000)
    assert [tube.youngs_modulus for tube in found.tubes] == [60_000, 50_000, 50_000]
    check_moduli(found)
