"""Groups of problems that share a robot: alike ones come together, and each problem gets its best robot."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from truth import TWO

from ctr_nlp import Manufacture, Problem, Robot, Settings, assign_to_robots, divide_problems, growing
from ctr_nlp.cli.main import main
from ctr_nlp.exceptions import OptionError
from ctr_nlp.paths.curve import curve_from_formula
from ctr_nlp.tube_design import plans
from ctr_nlp.tube_design.groups import _cluster_paths, assign_by_errors
from ctr_nlp.tube_design.plans import plan_tasks

PAIR = Robot(TWO.tubes)
RULES = Manufacture(channel=0.3, wall=0.1, outer=4.0)


def _task(name, radius, turned=0.0, frames=3):
    """An arc of 60 mm in a plane that is turned about z."""

    def arc(u):
        aside = radius * (1 - ca.cos(u / radius))
        return aside * np.cos(turned), aside * np.sin(turned), radius * ca.sin(u / radius)

    return Problem(name, PAIR, growing(curve_from_formula(arc, 0.0, 60.0), frames), duration=3.0)


@pytest.fixture(scope="module")
def tasks():
    """Two gentle arcs and two sharp ones, in planes of their own."""
    return [_task("gentle", 200.0), _task("sharp", 45.0, 2.0), _task("turned", 190.0, 1.0), _task("hook", 47.0)]


def test_alike_paths_are_grouped_whatever_their_plane(tasks):
    choice = _cluster_paths(tasks, 2, 0)
    assert choice[0] == choice[2] != choice[1] == choice[3]


def test_every_task_takes_its_best_robot_and_no_robot_is_left_over():
    errors = np.array([[0.1, 0.2, 0.9, np.nan], [0.3, 0.4, 1.0, 0.7], [1.0, 1.0, 1.0, 1.0]])
    assert assign_by_errors(errors).tolist() == [0, 0, 2, 1]
    assert assign_by_errors(errors[:2]).tolist() == [0, 0, 0, 1]
    assert assign_by_errors(errors[:1]).tolist() == [0, 0, 0, 0]


def test_tasks_are_divided_by_what_one_robot_follows(tasks):
    groups = divide_problems(tasks, 2, rules=RULES)
    assert sorted(sorted(task.name for task in group) for group in groups) == [
        ["gentle", "turned"],
        ["hook", "sharp"],
    ]
    assert all(task.robot == PAIR for group in groups for task in group)
    assert divide_problems(tasks, 1, rules=RULES) == [tasks]


def test_problems_take_the_robot_that_follows_them(tasks):
    outer, inner = PAIR.tubes
    straight = replace(PAIR, tubes=(replace(outer, curvature=1 / 400), replace(inner, curvature=1 / 400)))
    bent = replace(PAIR, tubes=(replace(outer, curvature=1 / 50), replace(inner, curvature=1 / 50)))
    assert assign_to_robots(tasks, [bent, straight], Settings()).tolist() == [1, 0, 1, 0]


def test_more_robots_than_problems_are_refused(tasks):
    with pytest.raises(OptionError, match="robots is 5 and there are 4 problems"):
        divide_problems(tasks, 5, rules=RULES)
    with pytest.raises(OptionError, match="robots is 0"):
        divide_problems(tasks, 0, rules=RULES)


def test_the_command_gives_each_group_a_robot_in_a_folder_of_its_own(tasks, tmp_path, capsys):
    paths = []
    for task in tasks[:3]:
        paths.append(tmp_path / f"{task.name}.csv")
        points = task.target_frames[-1].points
        np.savetxt(paths[-1], points, delimiter=",", header="x_mm,y_mm,z_mm", comments="")
    (tmp_path / "two.toml").write_text(PAIR.to_toml(), encoding="utf-8")
    out = tmp_path / "out"
    asked = ["design", *map(str, paths[:2]), "--hold-out", str(paths[2]), "--nominal", "--robots", "2"]
    asked += ["--robot", str(tmp_path / "two.toml"), "--frames", "3", "--starts", "1", "--out", str(out)]
    asked += ["--channel", "0.3", "--wall", "0.1", "--outer", "4", "--no-figures", "--jobs", "1"]
    assert main(asked) in (0, 1)
    files = {str(path.relative_to(out)) for path in out.rglob("*.*") if not path.name.startswith(".")}
    with_gentle = next(k for k in (1, 2) if f"robot_{k}/gentle.npz" in files)
    assert files == {
        *(f"robot_{k}/{name}" for k in (1, 2) for name in ("robot.toml", "design.json")),
        *(f"robot_{with_gentle}/{name}.npz" for name in ("gentle", "turned")),
        f"robot_{3 - with_gentle}/sharp.npz",
    }
    printed = capsys.readouterr().out
    assert "robot 1: tubes" in printed
    assert "held out" in printed


def test_plans_on_a_design_are_kept_within_walls_where_that_is_asked_for(tasks, monkeypatch):
    weights = []
    monkeypatch.setattr(plans, "solve_robust", lambda task, settings, **_: weights.append(settings.contact_weight))
    for walls in (False, True):
        plan_tasks(tasks[:1], Settings(contact_weight=7.0), False, walls=walls)
    assert weights == [0.0, 7.0]
