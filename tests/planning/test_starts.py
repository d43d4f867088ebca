"""Starts that share work: drafts of some frames lead to the motion that the exhaustive search finds."""

import math

import numpy as np
import pytest
from common import NAMES, named_problem

from ctr_nlp import Limits, Problem, Robot, Tube, curve_from_points, growing, solve_horizon, summary
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.horizon import EndConfigurations
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.planning.horizon import Horizon
from ctr_nlp.planning.marching import Pass
from ctr_nlp.planning.motions import per_frame_motions
from ctr_nlp.planning.starts.search import MIN_DRAFT_FRAMES, pick_draft_frames

FREE = Settings(contact_weight=0.0)
FOUND = 1e-4
"""Part of the objective by which a motion may be above the best that is known, and still be found."""
WORSE = 0.01
"""Part by which e3 may be larger on a named problem."""


def drawn(seed, frames=100):
    """Two to four tubes at random, and a path that winds at random and that they are long enough for."""
    rng = np.random.default_rng(seed)
    d = int(rng.integers(2, 5))
    outer, curved = 3.0 - 0.6 * np.arange(d), np.cumsum(rng.uniform(25, 60, d))
    lengths = np.cumsum(rng.uniform(10, 60, d)) + curved
    # Each tube is at least three times as stiff as the one within it, as the dominant model needs it.
    inner = outer - np.array([0.5, 0.3, 0.2, 0.1])[:d]
    tubes = [Tube(lengths[i], curved[i], rng.uniform(0.004, 0.02), outer[i], inner[i]) for i in range(d)]
    robot = Robot(tuple(tubes), Limits())
    length, bend, s = robot.reach * rng.uniform(0.7, 1.0), rng.uniform(0.3, 1.6), np.linspace(0, 1, 41)
    waves = [
        sum(rng.normal() * np.sin(np.pi * k * s + rng.uniform(0, 2 * np.pi)) / k for k in (1, 2, 3))
        for _ in range(2)
    ]
    a, b = (bend * (wave - wave[0]) / 2 for wave in waves)
    tangents = np.column_stack([np.sin(a) * np.cos(b), np.sin(b), np.cos(a) * np.cos(b)])
    steps = (tangents[1:] + tangents[:-1]) / 2 * length / 40
    path = curve_from_points(np.vstack([np.zeros(3), np.cumsum(steps, axis=0)]))
    return Problem(f"random {seed}", robot, growing(path, frames))


def above(problem, **options):
    """By what part the objective is above that of the exhaustive search, and e3."""
    found, best = (
        solve_horizon(problem, settings=FREE, exhaustive=every, **{"model": "dominant"} | options)
        for every in (False, True)
    )
    assert found.meta["options"]["motion_weight"] == best.meta["options"]["motion_weight"]
    assert found.complete >= best.complete
    numbers = (summary(one)["e3"] for one in (found, best))
    return found.objective.mean() / best.objective.mean() - 1, np.subtract(*numbers)


def share_found(seeds, frames=100):
    """The part of random problems on which the best motion of all is found."""
    parts = {seed: above(drawn(seed, frames))[0] for seed in seeds}
    missed = {seed: part for seed, part in parts.items() if part > FOUND}
    print(f"found on {len(parts) - len(missed)} of {len(parts)} problems; above the best by parts of {missed}")
    return 1 - len(missed) / len(parts)


def test_the_best_motion_is_found_on_random_problems():
    """Of three tubes, whose program other tests have compiled."""
    seeds = [seed for seed in range(12) if drawn(seed).robot.d == 3]
    assert len(seeds) >= 3
    assert share_found(seeds, frames=60) == 1


@pytest.mark.slow
def test_the_best_motion_is_found_on_many_random_problems():
    assert share_found(range(200)) >= 0.98


@pytest.mark.slow
@pytest.mark.parametrize("model", ["dominant", "elastic"])
@pytest.mark.parametrize("name", NAMES)
def test_no_named_problem_is_followed_worse_than_by_the_exhaustive_search(name, model):
    problem = named_problem(name)
    _, more = above(problem, model=model)
    assert more <= WORSE * summary(solve_horizon(problem, settings=FREE, exhaustive=True, model=model))["e3"]


@pytest.mark.parametrize("name", ["cos", "line_arc"])
def test_some_named_problems_are_followed_as_well(name):
    """On the cosine, runs of every fourth frame alone end in a motion whose objective is 15 % above the best."""
    objective, _ = above(named_problem(name))
    assert objective <= FOUND


def test_fewer_starts_are_solved_to_the_end():
    problem = named_problem("cos", 60)
    found, every = (
        solve_horizon(problem, model="dominant", settings=FREE, exhaustive=each) for each in (False, True)
    )
    assert len(found.meta["starts"]) < len(every.meta["starts"])
    assert found.meta["options"]["exhaustive"] is False
    assert every.meta["options"]["exhaustive"] is True


@pytest.mark.parametrize("frames", [2, 3, 24, 49, 50, 51, 100, 430, 5000])
def test_a_draft_ends_with_the_last_frame_and_has_frames_evenly_apart(frames):
    picked = pick_draft_frames(frames)
    assert picked[-1] == frames - 1
    assert len(set(np.diff(picked))) == 1
    assert min(frames, MIN_DRAFT_FRAMES) <= len(picked) < 2 * MIN_DRAFT_FRAMES
    assert picked[0] < picked[1] - picked[0]


def test_where_drafts_lead_to_no_solution_every_start_is_solved(monkeypatch):
    problem = named_problem("arc", 50)
    horizon = Horizon(problem, model="dominant", settings=FREE)
    monkeypatch.setattr("ctr_nlp.planning.starts.search.Search._drafts", lambda *_: [])
    motions = per_frame_motions(problem, EndConfigurations(), FREE, None, KINEMATIC_MODELS["dominant"])
    found = horizon.solve()
    assert found.complete
    assert len(found.meta["starts"]) == len(motions)


@pytest.mark.parametrize("model", ["dominant", "elastic"])
def test_the_first_motion_is_the_least_bad_of_all(model, monkeypatch):
    """Though the robot is moved through some alone."""
    problem, moved, plain = named_problem("line_arc", 20), list[Pass](), Pass.simulated_error

    def badness(one, *arguments):
        moved.append(one)
        return plain(one, *arguments)

    monkeypatch.setattr(Pass, "simulated_error", badness)
    motions = per_frame_motions(problem, EndConfigurations(), FREE, None, KINEMATIC_MODELS[model])
    assert len(moved) < len(motions)
    errors = []
    for motion in motions:
        q = motion if model == "dominant" else KINEMATIC_MODELS[model].configuration(problem.robot, motion)
        shapes = KINEMATIC_MODELS[model].points(problem.robot, motion, np.linspace(0, 1, 101))
        away = ((shapes - [frame.points for frame in problem.target_frames]) ** 2).sum(axis=-1)
        errors.append(math.sqrt(away.mean()))
        assert len(q) == problem.frames
    assert errors[0] <= min(errors) * 1.02
