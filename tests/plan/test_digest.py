"""A plan file that was changed after it was saved is refused, whatever was changed."""

import json

import numpy as np
import pytest
from malformed import plan

from ctr_nlp import Plan
from ctr_nlp.exceptions import OutputError


def entries_of(path):
    with np.load(path, allow_pickle=False) as data:
        return {name: data[name] for name in data.files}


@pytest.fixture
def path(tmp_path):
    plan().save(tmp_path / "plan.npz")
    return tmp_path / "plan.npz"


def refused(path, **changes):
    """Write a file with some entries changed or removed (None), which must be refused."""
    entries = {name: value for name, value in (entries_of(path) | changes).items() if value is not None}
    np.savez_compressed(path, **entries)
    with pytest.raises(
        OutputError, match=r"^plan .*plan\.npz was changed after it was saved; make a new plan"
    ) as raised:
        Plan.load(path)
    assert "\n" not in str(raised.value)


SAVED = ["time", "alpha", "beta", "theta", "target", "shape", "target_direction", "tip_direction", "solve_time"]
SAVED += ["objective", "kkt", "stability", "stability_between", "to_robot"]
SAVED += ["lumen", "lumen_radius", "clearance", "clearance_between"]


@pytest.mark.parametrize("name", SAVED)
@pytest.mark.hazard("plan changed after planning")
def test_the_least_change_of_a_number_is_refused(name, path):
    array = entries_of(path)[name].copy()
    array.flat[-1] = np.nextafter(array.flat[-1], np.inf) if np.isfinite(array.flat[-1]) else 1.0
    refused(path, **{name: array})


def test_a_frame_that_is_called_solved_is_refused(path):
    refused(path, success=~entries_of(path)["success"])


@pytest.mark.parametrize(
    "change",
    [
        {"model": "elastic"},
        {"options": {"stability_margin": None, "share": 0.5}},
        {"interrupted": True},
        {"mine": 1},
    ],
)
@pytest.mark.hazard("plan changed after planning")
def test_a_change_of_meta_is_refused(change, path):
    meta = json.loads(str(entries_of(path)["meta"])) | change
    refused(path, meta=np.array(json.dumps(meta)))


def test_an_array_that_was_removed_added_or_turned_is_refused(path):
    whole = path.read_bytes()
    for changes in (
        {"clearance": None, "clearance_between": None},
        {"truth": entries_of(path)["alpha"].repeat(3, axis=1)[:, :8]},
        {"alpha": entries_of(path)["alpha"].astype(np.float32)},
        {"digest": np.array("0" * 64)},
    ):
        path.write_bytes(whole)
        refused(path, **changes)


def test_a_file_of_before_and_one_with_more_in_it_are_read(path):
    entries = entries_of(path)
    np.savez(path, **entries, mine=np.arange(3))
    assert Plan.load(path) == plan()
    np.savez(path, **{name: value for name, value in entries.items() if name != "digest"})
    assert Plan.load(path) == plan()


def test_a_plan_that_is_loaded_and_saved_again_is_read(path, tmp_path):
    Plan.load(path).save(tmp_path / "again.npz")
    assert Plan.load(tmp_path / "again.npz") == plan()
    plan()[1:3].save(tmp_path / "again.npz")
    assert Plan.load(tmp_path / "again.npz") == plan()[1:3]
