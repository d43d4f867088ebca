"""What the tests share."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Generator
from pathlib import Path

import casadi as ca
import pytest
from hypothesis import HealthCheck, settings

from ctr_nlp import Problem, Robot, curve_from_formula, growing, table_i_robot
from ctr_nlp.codegen.language import QUICK_COMPILE_VARIABLE
from ctr_nlp.support.pool import BLAS_THREAD_VARIABLES

LONGEST = {"test_docs.py"}
"""Files that keep a process busy for as long as several others do."""
settings.register_profile(
    "quick", max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True
)
settings.load_profile("quick")


def pytest_configure(config: pytest.Config) -> None:
    """Keep compiled code, and what is known of devices, in a folder of this session and all its processes."""
    if hasattr(config, "workerinput"):
        return
    folder = tempfile.TemporaryDirectory(prefix="ctr_nlp-tests-", ignore_cleanup_errors=True)
    config.add_cleanup(folder.cleanup)
    os.environ["CTR_NLP_CACHE"] = str(Path(folder.name, "cache"))
    os.environ["CTR_NLP_STATE"] = str(Path(folder.name, "state"))
    os.environ.setdefault("CTR_NLP_COMPILE", "now")
    os.environ.setdefault(QUICK_COMPILE_VARIABLE, "1")
    for name in BLAS_THREAD_VARIABLES:
        os.environ.setdefault(name, "1")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Longest files first; last, those with tests of what happens in real time: these wait for all others."""
    real_time = {item.path for item in items if item.get_closest_marker("real_time")}
    items.sort(key=lambda item: (item.path in real_time, item.path.name not in LONGEST))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Tests of what happens in real time, which wait more than they work, run beside their own kind alone.

    Tests marked as interpreted compile nothing.
    """
    kinds = ["work", "real_time"]
    own = item.get_closest_marker("real_time") is not None
    folder = Path(os.environ["CTR_NLP_CACHE"]).parent
    with open(folder / "door", "w") as door, open(folder / kinds[own], "w") as room:
        fcntl.flock(door, fcntl.LOCK_EX)  # who waits until the other kind has left lets nobody else in
        with open(folder / kinds[not own], "w") as other:
            fcntl.flock(other, fcntl.LOCK_EX)
        fcntl.flock(room, fcntl.LOCK_SH)
        fcntl.flock(door, fcntl.LOCK_UN)
        with pytest.MonkeyPatch.context() as patch:
            if item.get_closest_marker("interpreted"):
                patch.setenv("CTR_NLP_COMPILE", "0")
            return (yield)


@pytest.fixture(scope="session")
def robot() -> Robot:
    """The seed's robot."""
    return table_i_robot()


@pytest.fixture(scope="session")
def arc_problem(robot: Robot) -> Problem:
    """Four frames along a planar arc of radius 100 mm and length 140 mm, towards -x."""
    path = curve_from_formula(lambda u: (100 * ca.cos(u) - 100, 0, 100 * ca.sin(u)), 0.0, 1.4)
    return Problem("quick_arc", robot, growing(path, 4))


@pytest.fixture(scope="session")
def cos_problem(robot: Robot) -> Problem:
    """Six frames along the seed's cosine."""
    path = curve_from_formula(lambda u: (10 * ca.cos(0.044 * u) - 10, 0, u), 0.0, 45.45 * ca.pi)
    return Problem("quick_cos", robot, growing(path, 6))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of shared test data: CTR_NLP_SHARED_DATA, else ../shared/data beside the repository."""
    default = Path(__file__).resolve().parents[1] / ".." / "shared" / "data"
    folder = Path(os.environ.get("CTR_NLP_SHARED_DATA", default)).resolve()
    if not folder.is_dir():
        pytest.skip(f"no shared data at {folder}; set CTR_NLP_SHARED_DATA to its folder")
    return folder
