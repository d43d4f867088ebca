"""Tubes for many ends: they are chosen by the last frames that keep off the wall and arrive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from truth import TWO

from ctr_nlp import (
    Manufacture,
    Problem,
    Robot,
    Settings,
    Tube,
    curve_from_points,
    design,
    divide_problems,
    growing,
    read_robot_files,
)
from ctr_nlp.anatomy.branch import Branch, Branches
from ctr_nlp.anatomy.formats.vtk import write_vtk
from ctr_nlp.anatomy.lumen_tree import read_lumen_tree
from ctr_nlp.cli.main import main
from ctr_nlp.exceptions import ProblemError
from ctr_nlp.ocp.frame_solver import FrameResult
from ctr_nlp.planning.last_frame import LastFrame, solve_last_frame
from ctr_nlp.planning.nlp_frames import NlpFrames
from ctr_nlp.studies.reach.end_problems import end_problems
from ctr_nlp.tube_design import co_design, reaching_tubes
from ctr_nlp.tube_design.reaching_tubes import (
    ReachingTubes,
    at_last_frames,
    choose_reaching_tubes,
    find_last_frames,
    grow_tubes,
)
from ctr_nlp.tube_design.request import search_for
from ctr_nlp.tube_design.search import nominal_scenario

PAIR = Robot(TWO.tubes)
RULES = Manufacture(channel=0.3, wall=0.1, outer=4.0)
BENDS_MM = 4.0, 8.0, 12.0, 24.0


def _task(bend, radius=2.0, frames=10):
    """A bend of 60 mm, by `bend` mm aside, within a lumen of a radius."""
    z = np.linspace(0.0, 60.0, 31)
    points = np.stack([bend * (1 - np.cos(z / 30)), 1e-5 * bend * z**3 / 3, z], axis=-1)
    curve = curve_from_points(points, np.full(len(z), radius))
    return Problem(f"bend {bend:g}", PAIR, growing(curve, frames), duration=5.0)


def _search(bends=BENDS_MM, **options):
    return at_last_frames(search_for([_task(bend) for bend in bends], rules=RULES, walls=True, **options))


def _tubes(excess):
    """Tubes with given excesses, mm; None for a task without a last frame."""
    rest = FrameResult(np.zeros(6), objective=1.0)
    frames = tuple(None if one is None else LastFrame(rest, 0.0, 0.0, one) for one in excess)
    return ReachingTubes("tubes", np.zeros(1), frames)


def test_last_frames_stand_alone_at_the_end_of_the_motion():
    search = _search()
    assert [task.frames for task in search.tasks] == [2] * len(BENDS_MM)
    for task, whole in zip(search.tasks, map(_task, BENDS_MM), strict=True):
        assert np.array_equal(task.target_frames[-1].points, whole.target_frames[-1].points)


def test_the_end_counts_in_the_last_frame_alone():
    """A motion of one frame is at its end; otherwise the tip's arrival would cost nothing there."""
    single = reaching_tubes._at_single_frames(_search())
    assert [task.target_frames[0].motion_fraction for task in single.tasks] == [1.0] * len(BENDS_MM)
    assert _search(model="dominant").priorities.arrival_weight > 0


@pytest.mark.parametrize(("radius", "good"), [(3.0, True), (1.2, False)])
def test_last_frame_ends_well_where_the_lumen_leaves_room(radius, good):
    task = replace(_task(24.0, radius, frames=2))
    best, *others = solve_last_frame(NlpFrames.of(task, model="elastic"))
    assert (best.excess == 0) is good
    assert all(best.rank <= one.rank for one in others)
    settings = Settings()
    over = max(best.contact - settings.contact_allowed, 0) + max(best.missed - settings.arrival_tolerance, 0)
    assert best.excess == pytest.approx(over)


def test_contact_of_a_last_frame_is_what_the_robot_shows():
    """The depth is that of the robot's surface beyond the radius, measured here from its points."""
    task = _task(24.0, 1.2, frames=2)
    frames = NlpFrames.of(task, model="elastic")
    best = solve_last_frame(frames)[0]
    shape = frames.model.points(task.robot, best.result.x[None], np.linspace(0, 1, 801))[0]
    line = task.target_frames[-1].points
    fine = np.stack(
        [np.interp(np.linspace(0, 1, 20001), np.linspace(0, 1, len(line)), axis) for axis in line.T], axis=-1
    )
    away = np.array([np.linalg.norm(fine - point, axis=1).min() for point in shape])
    inner = task.robot.tubes[-1].outer_diameter / 2
    assert away.max() + inner - 1.2 <= best.contact + 0.05
    assert best.missed == pytest.approx(np.linalg.norm(shape[-1] - line[-1]), abs=1e-6)


def test_tubes_grow_until_all_ends_are_within_reach():
    search = _search()
    own = search.tubes.nominal_unknowns
    wanted = np.ones(len(BENDS_MM), dtype=bool)
    before = find_last_frames(search, own)
    grown = grow_tubes(search, wanted, ("own", own, None))
    assert before.within_reach.sum() < grown.within_reach.sum() == len(BENDS_MM)
    assert search.tubes.satisfies_rules(grown.p)
    # Found anew on the tubes, without a hint where to look, all ends are still within reach.
    again = find_last_frames(search, grown.p)
    assert again.within_reach.all()


def test_tubes_grow_for_wanted_ends_alone():
    search = _search()
    own = search.tubes.nominal_unknowns
    wanted = find_last_frames(search, own).within_reach
    assert wanted.any()
    assert not wanted.all()
    assert np.array_equal(grow_tubes(search, wanted, ("own", own, None)).p, own)


def test_far_ends_do_not_count():
    """An end beyond MAX_ADDED_EXCESS_MM weighs no more than one at that distance."""
    wanted = np.ones(3, dtype=bool)
    assert _tubes([0.0, 1.0, 9.0]).score(wanted) == _tubes([0.0, 1.0, 90.0]).score(wanted)
    assert _tubes([0.0, 1.0, None]).score(wanted) == _tubes([0.0, 1.0, 90.0]).score(wanted)


def test_more_ends_come_before_nearer_ones():
    wanted = np.array([True, True, False])
    near, more = _tubes([0.0, 0.1, 0.0]), _tubes([0.0, 0.0, None])
    assert more.improves_on(near, wanted)
    assert not near.improves_on(more, wanted)
    assert _tubes([0.0, 0.3, 0.0]).improves_on(_tubes([0.0, 1.0, 0.0]), wanted)
    assert not _tubes([0.0, 0.95, 0.0]).improves_on(_tubes([0.0, 1.0, 0.0]), wanted)


def test_the_next_robot_is_chosen_for_the_ends_that_are_left(monkeypatch):
    """The greedy rule: the tubes that reach most come first, then those that reach most of the rest."""
    pool = [_tubes([0, 0, 0, 3]), _tubes([0, 0, 3, 3]), _tubes([3, 3, 3, 0])]
    monkeypatch.setattr(reaching_tubes, "_grow_all", lambda *_: pool)
    search = search_for([_task(bend) for bend in BENDS_MM], rules=RULES, walls=True)
    notes = []
    chosen = choose_reaching_tubes(search, 2, 0, progress=lambda *told: notes.append(told))
    assert chosen == [pool[0], pool[2]]
    assert notes[-1] == (2, 2, "tubes of robot 2, 4 of 4 ends within reach")


def test_problems_within_walls_are_divided_by_reach(monkeypatch):
    first, second = _tubes([0, 0, 3, None]), _tubes([3, 0, 0, 3])
    monkeypatch.setattr("ctr_nlp.tube_design.groups.choose_reaching_tubes", lambda *_: [first, second])
    tasks = [_task(bend) for bend in BENDS_MM]
    own = search_for(tasks, rules=RULES, walls=True).tubes.nominal_unknowns
    for one in (first, second):
        object.__setattr__(one, "p", own)
    groups = divide_problems(tasks, 2, rules=RULES, walls=True)
    assert [[task.name for task in group] for group in groups] == [["bend 4", "bend 8"], ["bend 12", "bend 24"]]


@pytest.mark.slow
def test_a_design_for_many_ends_reaches_them(monkeypatch):
    monkeypatch.setattr(co_design, "MAX_TASKS_WITH_MOTIONS", 2)
    found = design([_task(bend) for bend in BENDS_MM[1:]], nominal=True, walls=True, rules=RULES, starts=1)
    assert all(plan.verdicts.end_reached_as_described for plan in found.plans)
    assert all(plan.verdicts.holds.word == "NOT CHECKED" for plan in found.plans)
    assert len(found.start_results) == 1


@pytest.mark.slow
def test_a_round_on_a_single_frame_improves_it():
    """The joint program of single frames counts the arrival: its solution brings the tip to the end."""
    search = reaching_tubes._at_single_frames(_search((24.0,)))
    known = find_last_frames(_search((24.0,)), search.tubes.nominal_unknowns)
    found = known.as_candidate(search)
    again = search.run_round(found, nominal_scenario, 1e-3, 0.1)
    assert again.motions.rms < found.motions.rms


# the command


def _fork(folder):
    """A file of centrelines with two ends, in which the shipped robots have room."""
    pytest.importorskip("pyvista", reason='needs pyvista: pip install -e ".[anatomy]"')
    along = np.arange(0.0, 61.0, 2.0)
    sides = [
        np.stack([side * np.maximum(along - 30, 0), np.zeros_like(along), along], axis=-1) for side in (-0.5, 0.5)
    ]
    lines = tuple(Branch(f"end {k}", points, np.full(len(points), 5.0)) for k, points in enumerate(sides))
    file = folder / "fork.vtp"
    write_vtk(file, Branches(lines, "LPS", np.eye(4)))
    return str(file)


def test_every_end_of_a_tree_is_a_problem(tmp_path, monkeypatch):
    seen = []

    def stop(tasks, *_, **__):
        seen.extend(tasks)
        raise ProblemError("seen")

    monkeypatch.setattr("ctr_nlp.cli.studies.design.divide_problems", stop)
    asked = ["design", _fork(tmp_path), "--every-end", "--walls", "--outer", "2.8", "--out", str(tmp_path / "out")]
    assert main(asked) == 2
    assert sorted(task.name for task in seen) == ["fork-1", "fork-2"]
    assert {task.robot for task in seen} == {next(iter(read_robot_files().values()))}
    assert all(task.wall is not None for task in seen)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--every-end", "--branch", "left"], "--branch does not go with --every-end"),
        (["--every-end", "--target", "0", "0", "1"], "--target does not go with --every-end"),
        (["--every-end", "--trim", "end"], "--trim end does not go with --every-end"),
        (["--every-end", "--from-carina", "--entry", "0", "0", "0"], "--from-carina does not go with --entry"),
        (["--from-carina"], "--from-carina goes with --every-end"),
    ],
)
def test_options_that_contradict_every_end_are_refused(options, message, tmp_path, capsys):
    assert main(["design", _fork(tmp_path), *options, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err


def test_every_end_needs_a_tree(tmp_path, capsys):
    assert main(["design", "cos", "--every-end", "--out", str(tmp_path / "out")]) == 2
    assert "--every-end goes with a mask or a centreline file; cos is none" in capsys.readouterr().err


def test_a_tree_without_room_for_the_robot_has_no_problems(tmp_path):
    tree = read_lumen_tree(_fork(tmp_path))
    thick = Robot((Tube(90, 50, 1 / 130, outer_diameter=13, inner_diameter=12.6),))
    with pytest.raises(ProblemError, match="no end that the robot can be planned to; the first of them: radius"):
        end_problems(tree, thick)
