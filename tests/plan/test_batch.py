"""Many robots in one call: `ctr_nlp.batch` at rest, and `simulate_samples` along motions."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import ctr_nlp as ctr
from ctr_nlp.exceptions import OptionError, RobotError
from ctr_nlp.models import model_named
from ctr_nlp.plan import batch as door
from ctr_nlp.plan.simulation import simulate_motion

ROBOT = ctr.table_i_robot()


def poses(count, seed=0):
    """Random configurations within the limits of the paper's robot, some of which make it fall."""
    rng = np.random.default_rng(seed)
    alpha = rng.uniform(0, 2 * np.pi, (count, 3))
    beta = np.sort(rng.random((count, 3)), axis=1) * ROBOT.upper[3:6]
    return np.hstack([alpha, beta, rng.uniform(-0.5, 0.5, (count, 2))])


def at_rest():
    """What a batch of poses has, at five points of each."""
    return ctr.batch(ROBOT, poses(300), np.linspace(0, 1, 5))


def test_a_batch_has_what_single_configurations_have():
    q = poses(12)
    found = ctr.batch(ROBOT, q)
    assert found.is_solved.all()
    for k, row in enumerate(q):
        alone = simulate_motion(ROBOT, row[None], "elastic")
        np.testing.assert_allclose(found.points[k], alone.shape[0], atol=1e-9)
        assert found.margins[k] == pytest.approx(alone.stability[0], abs=1e-12)


def test_threads_change_nothing():
    q = poses(9000)
    one = ctr.batch(ROBOT, q, np.linspace(0, 1, 5), threads=1)
    three = ctr.batch(ROBOT, q, np.linspace(0, 1, 5), threads=3)
    for some, others in zip(one, three, strict=True):
        np.testing.assert_array_equal(some, others)


def test_samples_have_a_row_each():
    samples = ctr.sample_robots(ROBOT, 20, seed=1)
    q = poses(20, seed=1)
    found = ctr.batch(samples, q)
    # The motors' zeros of samples are off.
    turned = q + np.pad(samples.offsets, ((0, 0), (0, 5)))
    x = model_named("elastic").rest_batch(samples.structure, samples.numbers, turned, np.ones(1)).x
    np.testing.assert_array_equal(found.x, x)
    with pytest.raises(RobotError, match=r"robot has 20 samples and q 3 rows"):
        ctr.batch(samples, q[:3])


def test_what_is_not_known_is_not_solved():
    q = poses(5)
    q[2, 0] = np.nan
    found = ctr.batch(ROBOT, q, np.ones(1))
    assert found.is_solved.tolist() == [True, True, False, True, True]
    assert np.isnan(found.points[2]).all()
    assert np.isnan(found.margins[2])


def test_motions_are_the_same_in_several_threads():
    q = np.linspace([0, 0, 0, 10, 20, 30, 0, 0], [0.5, 2.5, 6.0, 40, 90, 150, 0, 0], 8)
    samples = ctr.sample_robots(ROBOT, 150, seed=0)
    one = ctr.simulate_samples(ROBOT, samples, q, threads=1)
    two = ctr.simulate_samples(ROBOT, samples, q, threads=2)
    for some, others in zip(one, two, strict=True):
        np.testing.assert_array_equal(some, others)


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the option is one of compilers for x86-64")
def test_vectors_of_four_find_the_same(tmp_path):
    """A process whose compiler knows no AVX-512 has four robots side by side."""
    to = tmp_path / "found.npz"
    code = (
        f"import ctr_nlp as ctr, numpy as np, test_batch; np.savez({str(to)!r}, **test_batch.at_rest()._asdict())"
    )
    compiler = {"CC": "gcc -mno-avx512f", "CTR_NLP_COMPILE": "now"}
    paths = os.pathsep.join([str(Path(ctr.__file__).parents[1]), str(Path(__file__).parent)])
    subprocess.run([sys.executable, "-c", code], env=os.environ | compiler | {"PYTHONPATH": paths}, check=True)
    with np.load(to) as found:
        for name, expected in at_rest()._asdict().items():
            np.testing.assert_allclose(found[name], expected, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"q": np.zeros((2, 5))}, RobotError, r"q has shape \(2, 5\); it must be \(n, 8\)"),
        ({"robot": 3}, RobotError, "robot"),
        ({"sigma": np.array([0.0, 1.5])}, OptionError, r"sigma has shape \(2,\), from 0 to 1.5"),
        ({"threads": 0}, OptionError, "threads is 0"),
        ({"device": "gpu"}, OptionError, "device is 'gpu'"),
        ({"model": "dominant"}, OptionError, "does not find robots at rest in a batch"),
    ],
)
def test_bad_input_is_named(change, error, message):
    with pytest.raises(error, match=message):
        ctr.batch(**{"robot": ROBOT, "q": poses(2)} | change)


def test_a_card_that_is_not_there_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "nvidia.cuda_nvrtc", None)
    with pytest.raises(OptionError, match=r"pip install \"ctr_nlp\[gpu\]\""):
        ctr.batch(ROBOT, poses(2), device="cuda")
    monkeypatch.setitem(sys.modules, "nvidia.cuda_nvrtc", ctr)
    monkeypatch.setattr(door.ctypes.util, "find_library", lambda name: None)
    with pytest.raises(OptionError, match="no driver"):
        ctr.simulate_samples(ROBOT, ctr.sample_robots(ROBOT, 2, seed=0), poses(2), device="cuda")
