"""Tubes of stock: lists are read or refused by line and column, what is chosen nests, designs keep the rules."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from truth import TWO

from ctr_nlp import (
    Manufacture,
    Problem,
    Robot,
    Tube,
    curve_from_formula,
    design,
    growing,
    summary,
    table_i_robot,
)
from ctr_nlp.cli.main import main
from ctr_nlp.exceptions import OptionError
from ctr_nlp.ocp.shared.design import DesignedTubes, with_linear_curvatures
from ctr_nlp.problems import named_problem
from ctr_nlp.tube_design.design_warnings import find_design_warnings
from ctr_nlp.tube_design.rounding import round_entries
from ctr_nlp.tube_design.stock import StockTube, nearest_stock, read_stock, with_diameters

PAIR = Robot(TWO.tubes)
RULES = Manufacture(channel=0.3, wall=0.1, outer=4.0)
HEAD = "part,outer_diameter_mm,inner_diameter_mm\n"


def _file(folder, text):
    path = folder / "list.csv"
    path.write_text(text, encoding="utf-8")
    return path


def _task(name, bend, twist=0.0):
    curve = curve_from_formula(lambda u: (bend * (1 - ca.cos(u / 40)), twist * ca.sin(u / 20), u), 0.0, 70.0)
    return Problem(name, PAIR, growing(curve, 6), duration=3.0)


def test_every_tube_of_the_package_names_its_source():
    stock = read_stock()
    assert len(stock) == len({(one.outer, one.inner) for one in stock}) >= 12
    for one in stock:
        assert one.outer > one.inner > 0
        assert len(one.source) > 10


def test_lists_in_inches_are_in_millimetres(tmp_path):
    text = "# ours\npart,price,outer_diameter_in,inner_diameter_in\nA-1,3,0.058,0.050\n"
    (one,) = read_stock(_file(tmp_path, text))
    assert one[:3] == ("A-1", pytest.approx(1.4732), pytest.approx(1.27))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "it has no rows"),
        (
            "part,od\nA,1\n",
            "must have rows, and columns part, outer_diameter_mm and inner_diameter_mm .* it has od, part",
        ),
        (
            HEAD + "A,2,1\nB,two,1\n",
            "line 3 of the stock .*: outer_diameter_mm is 'two'; it must be a number between",
        ),
        ("# ours\n" + HEAD + "A,2,\n", "line 3 of the stock .*: inner_diameter_mm is ''"),
        (HEAD + "A,2\n", "line 2 of the stock .*: inner_diameter_mm is None"),
        (HEAD + "A,1,2\n", "inner_diameter_mm is '2'; it must be less than outer_diameter_mm, which is '1'"),
    ],
)
def test_bad_lists_are_refused_by_line_and_column(tmp_path, text, told):
    with pytest.raises(OptionError, match=told):
        read_stock(_file(tmp_path, text))


def test_a_list_that_is_not_there_is_said(tmp_path):
    with pytest.raises(OptionError, match="cannot be read"):
        read_stock(tmp_path / "none.csv")


def test_tubes_that_nest_are_found_best_ratios_first():
    """As all combinations of the list, looked at one by one."""
    tubes, stock = DesignedTubes(with_linear_curvatures(table_i_robot()), Manufacture()), read_stock()
    found = nearest_stock(stock, tubes, tubes.nominal_unknowns)
    nesting = {
        three
        for three in itertools.product(stock, repeat=3)
        if all(one.outer - one.inner > 0.3 - 1e-9 for one in three)
        and all(outer.inner - inner.outer > 0.1 - 1e-9 for outer, inner in itertools.pairwise(three))
        and three[2].inner > 1 - 1e-9
    }
    assert set(found) == nesting
    assert [one.part for one in found[0]] == ["Table I tube 1", "Table I tube 2", "Table I tube 3"]


def test_where_something_pushes_stiffness_itself_counts():
    """Thin tubes of the same ratios have the same shape, as long as nothing acts on them."""
    tubes = DesignedTubes(table_i_robot(), Manufacture(channel=0.4, wall=0.1, clearance=0.05, outer=6.0))
    own = [(tube.outer_diameter, tube.inner_diameter) for tube in tubes.robot.tubes]
    thin = [StockTube("thin", 0.6 * outer, 0.6 * inner, "here") for outer, inner in own]
    like = [StockTube("alike", 1.01**k * outer, inner, "here") for k, (outer, inner) in enumerate(own)]
    for pushed, part in ((False, "thin"), (True, "alike")):
        assert {one.part for one in nearest_stock([*thin, *like], tubes, tubes.nominal_unknowns, pushed)[0]} == {
            part
        }


def test_what_cannot_nest_is_refused_before_anything_is_solved():
    stock = [StockTube("A", 2.0, 1.0, "here")]
    with pytest.raises(OptionError, match="no 2 tubes of the stock nest with walls of at least"):
        design([_task("bend", 12.0)], nominal=True, rules=RULES, stock=stock)


def test_a_fixed_diameter_stays_and_thick_tubes_are_bent_less():
    tubes = DesignedTubes(with_linear_curvatures(table_i_robot()), Manufacture(), ("outer_diameter_1",))
    found = nearest_stock(read_stock(), tubes, tubes.nominal_unknowns)
    assert {(one[0].outer, one[0].inner) for one in found} == {(5.7, 4.3)}
    p = with_diameters(
        tubes, np.where(np.arange(len(tubes.nominal_unknowns)) < 6, 50.0, tubes.nominal_unknowns), found[0]
    )
    for k in range(6):
        assert p[k] / 100 * found[0][k // 2].outer / 2 <= 0.04 + 1e-12


def test_lengths_and_curvatures_are_rounded_to_what_can_be_made():
    tubes = DesignedTubes(with_linear_curvatures(table_i_robot()), Manufacture())
    p = tubes.nominal_unknowns.copy()
    p[:6] = 100 / np.array([9876.5, 222.2, 5000.0, 61.7, 700.0, 80.2])
    p[6:8] = 0.4512, 1.0333
    found = round_entries(tubes, p, tubes.names[:9])[0]
    np.testing.assert_allclose(100 / found[:6], [9900, 220, 5000, 62, 700, 80], rtol=1e-12)
    np.testing.assert_allclose(100 * found[6:9], [45.0, 103.5, 150.0], rtol=1e-12)
    np.testing.assert_array_equal(found[9:], p[9:])


def test_rounding_keeps_the_rules():
    """The nearest radius would strain the tube by more than 4 %."""
    tubes = DesignedTubes(table_i_robot(), Manufacture())
    p = tubes.nominal_unknowns.copy()
    p[1] = 100 / (3.7 / 2 / 0.04 + 0.1)
    assert tubes.satisfies_rules(p)
    assert 100 / round_entries(tubes, p, tubes.names[:3])[0][1] == pytest.approx(47.0)


@pytest.fixture(scope="module")
def stocked():
    """Two bends, followed by two tubes of a list in steps of 0.1 mm."""
    sizes = itertools.product(range(6, 34), (0.1, 0.15, 0.2, 0.3))
    stock = [StockTube(f"{k}/{wall}", k / 10, round(k / 10 - 2 * wall, 2), "here") for k, wall in sizes]
    stock = [one for one in stock if one.inner > 0.1]
    tasks = [_task("bend", 12.0), _task("turn", 18.0, 3.0)]
    return stock, design(tasks, nominal=True, rules=RULES, starts=1, stock=stock)


def test_a_design_in_stock_is_of_the_list_and_keeps_the_rules(stocked):
    stock, found = stocked
    own = [(tube.outer_diameter, tube.inner_diameter) for tube in found.robot.tubes]
    assert own == [(one.outer, one.inner) for one in found.stock_rounding.tubes]
    assert set(found.stock_rounding.tubes) <= set(stock)
    for rule in found.rules:
        assert rule.lower <= rule.value <= rule.upper, rule
    for tube in found.robot.tubes:
        for curvature in (tube.root_curvature, tube.tip_curvature):
            radius = 1 / curvature
            step = 1 if radius <= 200 else 10 if radius <= 2000 else 100
            assert radius / step == pytest.approx(round(radius / step), abs=1e-6)
    assert found.robot.tubes[0].curved_length % 0.5 == 0


def test_a_design_in_stock_loses_little_and_tells_it(stocked):
    _, found = stocked
    assert all(plan.success.all() for plan in found.plans)
    rms = np.sqrt(np.mean([summary(plan)["e3"] ** 2 for plan in found.plans]))
    free = np.sqrt(np.mean(found.stock_rounding.free_errors**2))
    assert rms < 1.1 * free
    assert found.stock_rounding.loss == pytest.approx(
        np.sqrt(np.mean(found.stock_rounding.rounded_errors**2)) / free - 1
    )
    assert "e3 by" in str(found.stock_rounding)


PROGRAM = """
def problem(frames, duration, robot):
    curve = curve_from_formula(lambda u: (12 * (1 - ca.cos(u / 40)), 0 * u, u), 0.0, 70.0)
    return Problem("bend", robot, growing(curve, frames), duration=duration)
"""


@pytest.mark.slow
def test_the_command_rounds_to_a_list_and_says_what_is_lost(tmp_path, capsys):
    pair = tmp_path / "two.toml"
    pair.write_text(PAIR.to_toml(), encoding="utf-8")
    rows = [f"T{k},{outer},{outer - 0.3:.2f}" for k, outer in enumerate((0.9, 1.2, 1.5, 1.9, 2.4))]
    path, out = _file(tmp_path, HEAD + "\n".join(rows)), tmp_path / "out"
    program = "import casadi as ca\nfrom ctr_nlp import Problem, curve_from_formula, growing\n\n" + PROGRAM
    (tmp_path / "bend.py").write_text(program, encoding="utf-8")
    asked = [
        "design",
        str(tmp_path / "bend.py"),
        "--nominal",
        "--model",
        "dominant",
        "--robot",
        str(pair),
        "--frames",
        "6",
        "--starts",
        "1",
    ]
    asked += ["--channel", "0.3", "--wall", "0.1", "--outer", "4", "--stock", str(path), "--out", str(out)]
    assert main([*asked, "--no-figures"]) in (0, 1)
    assert "Tubes of stock" in capsys.readouterr().out
    told = json.loads((out / "design.json").read_text())
    assert len(told["stock"]["tubes"]) == 2
    assert len(told["stock"]["e3_free"]) == len(told["stock"]["e3"]) == 1
    assert isinstance(told["doubts"], list)


def test_a_bad_list_ends_the_command(tmp_path, capsys):
    assert main(["design", "line", "--stock", str(tmp_path / "none.csv"), "--out", str(tmp_path / "o")]) == 2
    assert "cannot be read" in capsys.readouterr().err


class _Moved:
    """Of a plan, how far tubes are pushed out."""

    def __init__(self, beta):
        self.beta = np.array(beta, dtype=float)


def test_tubes_that_are_not_used_are_named():
    robot = table_i_robot()
    (told,) = find_design_warnings(robot, [_Moved([[0, 20, 90], [1.5, 40, 150]]), _Moved([[0, 0, 30]])], sold=True)
    assert told.startswith("Tube 1 never extends by more than 1.5 mm")
    assert find_design_warnings(robot, [_Moved([[20, 60, 90]])], sold=True) == ()
    soft = replace(robot, tubes=(*robot.tubes[:2], replace(robot.tubes[2], youngs_modulus=0.01)))
    (told,) = find_design_warnings(soft, [_Moved([[20, 88, 90]])], sold=True)
    assert told.startswith("Tube 3 has little effect: it has at least 2% of the stiffness on")


def test_diameters_that_are_not_sold_are_named():
    thick = Robot((Tube(90.0, 50.0, 0.01, 5.0, 2.0), Tube(190.0, 90.0, 0.01, 1.5, 1.2)))
    (told,) = find_design_warnings(thick, [_Moved([[20, 60]])], sold=False)
    assert told.startswith("The outer diameter of tube 1 is 2.50 times the inner")


def test_a_design_for_one_straight_line_is_no_needle():
    found = design([_task("straight", 0.0)], nominal=True, rules=RULES, starts=1)
    assert summary(found.plans[0])["e3"] < 0.05
    for tube in found.robot.tubes:
        assert tube.outer_diameter - tube.inner_diameter >= 0.2 - 1e-9


@pytest.mark.slow
def test_a_design_for_one_straight_line_names_the_tube_that_it_does_not_need():
    found = design([named_problem("line", 20)], nominal=True, starts=2)
    assert any("never extends" in told or "little effect" in told for told in found.warnings), found.warnings
