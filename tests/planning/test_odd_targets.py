"""Targets at random, odd ones among them: refused in one line, or known all along, and errors can be computed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from malformed import helix, plan
from strategies import numbers

from ctr_nlp import Problem, Target, curve_from_points, growing, sequence, summary, table_i_robot
from ctr_nlp.exceptions import CtrError
from ctr_nlp.paths.placement import move_to_robot_frame
from ctr_nlp.planning.nlp_frames import NlpFrames

PATH = curve_from_points(helix(), np.full(61, 6.0))
ODDITIES = {
    "none": lambda points: points,
    "closed": lambda points: np.vstack([points, points[:1]]),
    "there and back": lambda points: np.vstack([points, points[-2::-1]]),
    "there and nearly back": lambda points: np.vstack([points, points[-2::-1] + 1e-3]),
    "a point twice": lambda points: np.insert(points, 1, points[0], axis=0),
    "a point nearly twice": lambda points: np.insert(points, 1, points[0] + 1e-5, axis=0),
    "too few": lambda points: points[:3],
    "far": lambda points: points + 1e5,
    "metres": lambda points: points * 1e-3,
    "flat": lambda points: points * [1, 0, 1],
    "straight": lambda points: points * [0, 0, 1],
    **{
        f"{number} somewhere": lambda points, number=number: np.where(
            np.indices(points.shape)[0] == 1, number, points
        )
        for number in (math.nan, math.inf, 1e300, -1e7)
    },
}


@st.composite
def odd_points(draw):
    """Points a few millimetres apart, and what is odd about them."""
    steps = draw(st.lists(st.tuples(numbers(-9, 9), numbers(-9, 9), numbers(0.1, 9)), min_size=4, max_size=12))
    return ODDITIES[draw(st.sampled_from(list(ODDITIES)))](np.cumsum(steps, axis=0))


def refused_or(make):
    """What make() gives, or None where it is refused in one line."""
    try:
        return make()
    except CtrError as error:
        said = str(error)
    assert len(said.splitlines()) == 1
    return None


@settings(max_examples=60, phases=[Phase.explicit, Phase.generate])
@given(odd_points(), st.sampled_from([0.0, 0.5, 20.0]), st.booleans(), st.integers(1, 4))
def test_points_at_random_are_a_target_or_refused(points, smoothing, with_radius, frames):
    radius = np.full(len(points), 3.0) if with_radius else None

    def make():
        curve = curve_from_points(points, radius, smoothing)
        shorter = curve.part(0.0, min(curve.length, 149.0))
        return Problem("odd", table_i_robot(), growing(move_to_robot_frame(shorter)[0], frames)).target_frames

    samples = refused_or(make)
    for sample in samples or ():
        assert len(samples) == frames
        assert np.isfinite(sample.points).all()
        np.testing.assert_allclose(np.linalg.norm(sample.tangents, axis=1), 1.0, atol=1e-6)
        assert (sample.curvature >= 0).all()
        chords = np.linalg.norm(np.diff(sample.points, axis=0), axis=1)
        assert chords.sum() <= 1.01 * sample.length


@given(
    st.lists(st.sampled_from([0.5, 1.0, 10.0, 70.0, 72.0, 1e-6, 0.0, -1.0, 500.0, math.nan, math.inf]), max_size=5)
)
def test_lengths_at_random_are_a_target_or_refused(lengths):
    target = refused_or(lambda: Target((PATH,) * len(lengths), tuple(lengths)))
    good = bool(lengths) and all(0 < length <= PATH.length for length in lengths)
    assert (target is not None) == good


@settings(max_examples=10)
@given(st.integers(0, 2), st.sampled_from(["point", "tangent", "curvature", "radius"]), st.floats(0, 0.98))
def test_a_frame_that_is_not_known_all_along_is_named(frame, name, part):
    """Nothing is known beyond a part of one frame's curve."""

    def lost(s):
        values = np.array(getattr(PATH, name)(s))
        values[s >= part * PATH.length] = math.nan
        return values

    curves = [replace(PATH, **{name: lost}) if k == frame else PATH for k in range(3)]
    with pytest.raises(CtrError, match=rf"{name} of frame {frame + 1} of the target has nan"):
        NlpFrames.of(Problem("odd", table_i_robot(), sequence(curves)), "two-stage", "ipopt")


@pytest.mark.parametrize("frames", [1, 4])
def test_plans_of_odd_motions_have_a_summary(frames):
    """A single frame, and one in which nothing was reached."""
    arrays = {
        name: getattr(plan(), name)[:frames] for name in ("time", "alpha", "beta", "theta", "target", "shape")
    }
    arrays |= {
        n: getattr(plan(), n)[:frames] for n in ("target_direction", "tip_direction", "solve_time", "success")
    }
    arrays |= {n: getattr(plan(), n)[:frames] for n in ("objective", "kkt", "stability", "stability_between")}
    short = replace(plan(), **arrays, lumen_radius=None, clearance=None)
    assert summary(short)["e3"] >= 0
    missing = replace(
        short, **{name: np.nan * getattr(short, name) for name in ("alpha", "shape", "tip_direction")}
    )
    assert summary(missing)["e3"] is None
