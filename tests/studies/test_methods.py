"""One table of methods and problems: what is measured, what is refused, and what is set in bold."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from compare import main
from methods.comparison import LUMEN_PATH_VARIANTS, ROBUST_VARIANTS, Comparison, Refusal, compare, parse_variant
from methods.metrics import every_method, measure_plan
from methods.page import METHOD_PAGE_COLUMNS, method_description, page, table
from reference import REFERENCE_METHODS

from ctr_nlp import Problem, Robot, Settings, curve_from_points, growing, table_i_robot
from ctr_nlp.exceptions import OptionError
from ctr_nlp.plan.measures import follow_the_leader_deviation
from ctr_nlp.planning.per_frame import solve_per_frame
from ctr_nlp.problems import named_problem

ROBOT = table_i_robot()
ALIKE = {column.key: 1.0 for column in METHOD_PAGE_COLUMNS} | {
    column.planned: 1.0 for column in METHOD_PAGE_COLUMNS if column.planned
}


def row(variant, **numbers):
    whole = {"problem": "bend", "variant": variant, "solved": 9, "frames": 9, "draws": 40, "interrupted": False}
    return whole | ALIKE | numbers


def cells(text, variant):
    line = next(line for line in text.splitlines() if line.startswith(f"| `{variant}`"))
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_every_method_of_every_registry_is_there_once():
    names = every_method()
    assert len(names) == len(set(names))
    assert {*REFERENCE_METHODS, *ROBUST_VARIANTS, *LUMEN_PATH_VARIANTS} <= {*names}
    assert all(parse_variant(name).name == name for name in names)


def test_a_method_that_does_not_serve_a_problem_is_a_refusal_and_the_others_go_on():
    variants = [parse_variant(name) for name in ("rrt-connect", "two-stage:ipopt:elastic", "tip-jacobian")]
    found = compare([named_problem("arc", 3)], variants)
    assert [row["variant"] for row in found.rows] == ["tip-jacobian"]
    assert [refusal.variant for refusal in found.refusals] == ["rrt-connect", "two-stage:ipopt:elastic"]
    assert all("\n" not in refusal.why for refusal in found.refusals)
    with pytest.raises(OptionError, match="within a lumen, and arc has none"):
        compare([named_problem("arc", 3)], variants[:2])


def lone(frames):
    """A robot of one tube along a straight line of 40 mm."""
    line = np.column_stack([np.zeros((41, 2)), np.arange(41.0)])
    return Problem("lone", Robot(ROBOT.tubes[:1]), growing(curve_from_points(line), frames))


def test_plans_on_either_model_are_judged_on_the_elastic_one():
    """A lone tube twists nothing: on both models it is the same, and no draw of it is ever lost."""
    found = measure_plan("lone", "joint", solve_per_frame(lone(3), model="dominant"), 5)
    assert found["e3"] == pytest.approx(found["planned_e3"], abs=1e-6)
    assert found["lost"] == 0.0
    assert found["draws"] == 5
    assert found["depth"] is None
    assert found["solved"] == found["frames"] == 3
    three = measure_plan("arc", "joint", solve_per_frame(named_problem("arc", 10), model="dominant"), 5)
    assert three["e3"] > 2 * three["planned_e3"]


def test_a_robot_that_follows_its_leader_is_not_off_its_own_path():
    """A tube that comes out unturned stays on its own arc; half a turn away it is two sagittas off."""
    plan = solve_per_frame(lone(4), model="dominant")
    leader = replace(plan, alpha=0 * plan.alpha, theta=0 * plan.theta).evaluate_on("dominant")
    assert follow_the_leader_deviation(leader).max() < 1e-2
    turned = replace(leader, alpha=np.linspace(math.pi, 0, 4)[:, None]).evaluate_on("dominant")
    curvature, length = 1 / 130, float(turned.beta[0, 0])
    sagitta = (1 - math.cos(length * curvature)) / curvature
    assert follow_the_leader_deviation(turned)[0] == pytest.approx(2 * sagitta, rel=0.05)
    assert follow_the_leader_deviation(turned)[-1] == pytest.approx(0.0, abs=1e-9)


def test_what_is_least_is_bold_and_so_is_all_of_others_that_beats_ours():
    rows = [
        row("horizon:banded", e3=2.0, tip_max=3.0),
        row("joint:sqp", e3=3.0, tip_max=4.0),
        row("euclidean", e3=2.5, tip_max=2.0),
        row("tip-resolved", e3=9.0, tip_max=0.1),
        row("tip-jacobian", e3=0.5, tip_max=0.01, solved=8),
    ]
    text = table(Comparison(rows, [Refusal("bend", "rrt-connect", "it needs a lumen")], []), "bend")
    bold = {name: [cell.count("**") > 0 for cell in cells(text, name)] for name in (r["variant"] for r in rows)}
    e3, tip = 1, 3
    assert [bold[name][e3] for name in bold] == [True, False, False, False, False]
    assert [bold[name][tip] for name in bold] == [False, False, True, True, False]
    assert cells(text, "tip-jacobian")[-1] == "8 of 9"
    assert text.splitlines()[-1] == "- `rrt-connect` does not apply: it needs a lumen"
    assert cells(text, "euclidean")[e3].startswith("1 / 2.5") or "1.00 / 2.50" in cells(text, "euclidean")[e3]


def test_every_method_is_told_of_in_the_words_of_its_file():
    told = {name: method_description(name.partition(":")[0]) for name in every_method()}
    assert all(told.values())
    assert "tip" in told["tip-jacobian"].lower()
    assert told["rrt-connect"] != told["robust-joint"] != told["robust-horizon"]
    assert method_description("nobody's") == ""


def test_the_page_tells_how_it_is_made_and_nothing_of_where(tmp_path):
    rows = [row("joint:sqp"), row("tip-jacobian", e3=0.1, solved=1, interrupted=True)]
    text = page(Comparison(rows, [], []), "python scripts/studies/compare.py bend --all")
    assert "tip-jacobian" not in text
    assert "    python scripts/studies/compare.py bend --all\n" in text
    assert "cores of" in text
    assert not re.search(r"/(home|tmp|work|root)/", text)


def test_the_wall_counts_for_methods_that_know_it_and_all_goes_into_one_page(tmp_path, capsys):
    out = tmp_path / "out"
    given = ["bronchus", "--frames", "5", "--all", "--variants", "joint:sqp", "tip-jacobian", "joint:sqp:rigid"]
    assert main([*given, "--out", str(out)]) == 2
    assert not out.exists()
    main([*given[:-1], "two-stage:sqp:elastic", "--out", str(out)])
    ours, tip = json.loads((out / "comparison.json").read_text())
    assert ours["planned_depth"] < tip["planned_depth"]
    assert ours["draws"] == tip["draws"] == 200
    assert json.loads((out / "refusals.json").read_text())[0]["variant"] == "two-stage:sqp:elastic"
    assert "two-stage formulations need" in capsys.readouterr().out
    text = (out / "comparison.md").read_text()
    assert "python scripts/studies/compare.py bronchus --all --variants joint:sqp tip-jacobian" in text
    free = compare(
        [named_problem("bronchus", 5)],
        [parse_variant("joint:sqp")],
        Settings(contact_weight=0.0),
        None,
        measure_plan,
    )
    assert ours["planned_depth"] <= free.rows[0]["planned_depth"]
