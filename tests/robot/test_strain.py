"""What nitinol bears: the strain of tubes as made and as deployed, and numbers that are likely of another unit."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from strategies import numbers, robots

from ctr_nlp import Limits, Robot, Tube, table_i_robot
from ctr_nlp.exceptions import RobotError
from ctr_nlp.robot.strain import MAX_DEPLOYED_STRAIN, largest_strain
from ctr_nlp.robot.units import suggest_angle, suggest_curvature, suggest_length, unit_mismatch_factor


@given(numbers(0.3, 6), numbers(0, 0.16))
def test_a_tube_is_made_up_to_8_percent_strain_and_no_further(diameter, part):
    """Curvature times half the diameter, which is part / 2."""
    curvature = part / diameter
    assume(abs(part / 2 - 0.08) > 1e-6)
    if part / 2 <= 0.08 and curvature <= 0.5:
        assert Tube(100, 50, curvature, diameter, 0.0).curvature == curvature
    else:
        with pytest.raises(RobotError, match=r"nitinol allows 8 %|per mm is a radius"):
            Tube(100, 50, curvature, diameter, 0.0)


def test_the_57_percent_of_a_wide_tube_are_named():
    with pytest.raises(
        RobotError, match=r"0\.2 per mm, a radius of 5 mm, .*5\.7 mm: .*57 %.*at most 0\.0281 per mm"
    ):
        Tube(90, 50, 0.2, 5.7, 4.3)


def test_either_end_of_a_varying_curvature_counts():
    for ends in ((0.01, 0.09), (0.09, 0.01)):
        with pytest.raises(RobotError, match=r"strained by 9 %"):
            Tube(100, 50, ends, 2.0, 1.0)


def pair(inner_curvature, outer_curvature=0.0, modulus=1.0):
    """A stiff outer tube over half of the inner one's curved part."""
    outer = Tube(90, 50, outer_curvature, 4.0, 2.2, youngs_modulus=modulus)
    return Robot((outer, Tube(200, 100, inner_curvature, 2.0, 1.0)))


def test_the_deployed_strain_of_a_pair_by_hand():
    """The inner one of 1/20 mm in a straight outer one: both bend to k EI_2 / (EI_1 + EI_2)."""
    stiffness = [4.0**4 - 2.2**4, 2.0**4 - 1.0**4]
    common = 0.05 * stiffness[1] / sum(stiffness)
    worst = largest_strain(pair(0.05).tubes, [50, 100])
    assert worst.tube == 1 if 2 * common > 0.05 - common else worst.tube == 2
    assert worst.common == pytest.approx(common)
    assert worst.strain == pytest.approx(max(2 * common, 0.05 - common))
    assert 0 < worst.place < 50


def test_a_pair_that_bends_its_inner_tube_straight_by_more_than_6_percent_is_refused():
    """Against a rigid outer tube nothing is left of its own curvature but its strain, 2 / 2 * k."""
    pair(0.059, modulus=100.0)
    with pytest.raises(RobotError, match=r"tube 2 is strained by (6\.99|7) % at .*nitinol allows 6 %"):
        pair(0.07, modulus=100.0)


def test_a_lone_tube_and_tubes_of_one_curvature_are_not_strained():
    lone = Robot((Tube(200, 100, 0.07, 2.0, 1.0),))
    assert largest_strain(lone.tubes, lone.max_extensions).strain == 0
    alike = pair(0.03, 0.03)
    assert largest_strain(alike.tubes, alike.max_extensions).strain == pytest.approx(0, abs=1e-12)
    assert largest_strain(lone.tubes, [0.0]) is None


def test_tubes_that_are_not_over_each_other_do_not_strain_each_other():
    """With transmissions deployed, the inner one's curved part lies beyond the outer one's tip."""
    tubes = pair(0.05).tubes
    apart = Robot(tubes, Limits(beta=[(0, 50), (0, 200)]))
    assert largest_strain(apart.tubes, apart.max_extensions).strain == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("apart", [0.0, 1.5e-14, 1e-9, 9e-7, 1.1e-6, 1e-3])
def test_tubes_that_end_together_but_for_rounding_are_a_robot(apart):
    """Limits that are worked out from the travels of motors differ by what rounding leaves."""
    seed = table_i_robot()
    limits = Limits(beta=((0, 50), (0, 60 - apart), (0, 60)))
    assert replace(seed, limits=limits).max_extensions.tolist() == [50, 60 - apart, 60]
    assert largest_strain(seed.tubes, [50, 60 - apart, 60]).strain == pytest.approx(
        largest_strain(seed.tubes, [50, 60, 60]).strain, abs=1e-6
    )


@given(robots())
def test_no_section_is_strained_more_than_the_largest(robot):
    """Every section's both ends, curvatures and means worked out anew."""
    beta = robot.max_extensions
    worst = largest_strain(robot.tubes, beta)
    found = [0.0]
    for s in np.linspace(0, beta[-1], 301)[:-1] + 1e-7:
        there = [i for i in range(robot.d) if beta[i] > s]
        own = {}
        for i in there:
            tube, left = robot.tubes[i], beta[i] - s
            line = np.interp(left, [0, tube.curved_length], [tube.tip_curvature, tube.root_curvature])
            own[i] = line if left <= tube.curved_length else 0.0
        weights = np.array([robot.tubes[i].bending_stiffness for i in there])
        common = weights @ np.array(list(own.values())) / weights.sum()
        found += [robot.tubes[i].outer_diameter / 2 * abs(own[i] - common) for i in there]
    assert max(found) <= worst.strain + 1e-9 <= MAX_DEPLOYED_STRAIN + 1e-8


@given(robots())
def test_fully_deployed_is_the_largest_configuration_that_a_robot_allows(robot):
    q = np.concatenate([np.zeros(robot.d), robot.max_extensions, np.zeros(2)])
    robot.check(q)
    for i in range(robot.d):
        further = q.copy()
        further[robot.d + i] += 1e-3
        with pytest.raises(RobotError):
            robot.check(further)


def test_fully_deployed_keeps_the_carriage_gap():
    robot = table_i_robot().with_limits(beta=[(0, 5), (0, 107), (0, 150)], carriage_gap=20)
    assert robot.max_extensions.tolist() == [5, 5 + 202 - 90 - 20, 150]


# Units


def test_thousands_and_no_other_ratios_are_taken_for_units():
    """GPa and MPa, GPa and kPa; not steel beside polymers, nor what a test of limits takes for rigid."""
    for one, other in ((60, 60e3), (193, 75e3), (40, 200e3), (1, 1e6), (1e9, 1)):
        assert unit_mismatch_factor(one, other) == unit_mismatch_factor(other, one) is not None
    for one, other in ((200, 4), (60, 60), (75, 40), (1e4, 1), (1e7, 1)):
        assert unit_mismatch_factor(one, other) is None


def test_moduli_of_one_unit_are_accepted_and_of_two_refused():
    tubes = table_i_robot().tubes
    for modulus in (60.0, 60e3, 60e9):
        Robot(tuple(replace(tube, youngs_modulus=modulus) for tube in tubes))
    for i, factor in itertools.product(range(3), (1e3, 1e-3, 1e6)):
        mixed = tuple(
            replace(tube, youngs_modulus=60 * factor if k == i else 60.0) for k, tube in enumerate(tubes)
        )
        with pytest.raises(RobotError, match=r"youngs_modulus of tubes \d and \d .*must be in the same unit"):
            Robot(mixed)


@given(st.sampled_from(range(3)), st.sampled_from(["m", "um", "radius", "per metre"]))
def test_the_seed_in_another_unit_is_refused_with_what_was_meant(i, unit):
    tube = table_i_robot().tubes[i]
    factor = {"m": 1e-3, "um": 1e3}.get(unit, 1.0)
    bend = {"radius": 1 / tube.curvature, "per metre": 1e3 * tube.curvature}.get(unit, tube.curvature)
    meant = {"radius": rf"did you mean.*1/{bend:g}", "per metre": rf"did you mean.*{tube.curvature:g}"}
    with pytest.raises(RobotError, match=meant.get(unit, rf"did you mean {tube.length:g} mm|lie in \[1, 10000\]")):
        Tube(tube.length * factor, tube.curved_length * factor, bend, tube.outer_diameter, tube.inner_diameter)


def test_what_was_meant_is_offered_only_where_it_can_be():
    assert suggest_length(0.39, lambda mm: mm > 1) == ["390 mm (0.39 m)"]
    assert suggest_length(0.0, lambda mm: mm > 1) == []
    assert suggest_curvature(66.7, lambda k: k < 0.05) == ["1/66.7 (a radius of 66.7 mm)"]
    assert suggest_curvature(66.7, lambda k: k < 0.01) == []
    assert suggest_angle(90, lambda rad: rad < 2) == ["1.571 rad (90 degrees)"]
    assert suggest_angle(2 * math.pi, lambda rad: True) == []


def test_a_robot_in_degrees_is_refused():
    with pytest.raises(RobotError, match=r"theta_x.*did you mean -0\.7854 rad \(-45 degrees\)"):
        table_i_robot().with_limits(theta=(-45, 45))
    with pytest.raises(RobotError, match=r"alpha_1.*-180 degrees"):
        table_i_robot().with_limits(alpha=(-180, 180))
    assert table_i_robot().with_limits(alpha=(-6 * math.pi, 6 * math.pi)).d == 3
