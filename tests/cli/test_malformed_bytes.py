"""Files of bytes at random, and good files with some bytes changed: read, or refused in one line."""

from __future__ import annotations

import functools
import json

import nibabel
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from malformed import ENTRY, RIG, ROBOT, TARGET, legacy_vtk, markups, mask, plan_file, table, voxels, written

from ctr_nlp import Plan, Robot, problem_from_file, read_csv, table_i_robot
from ctr_nlp.cli.arguments import read_start
from ctr_nlp.exceptions import CtrError
from ctr_nlp.hardware.description import Hardware

READERS = {
    "robot.toml": (Robot.from_toml, ROBOT.encode()),
    "rig.toml": (Hardware.from_toml, RIG.encode()),
    "path.csv": (read_csv, table().encode()),
    "c.mrk.json": (problem_from_file, json.dumps(markups()).encode()),
    "lines.vtk": (problem_from_file, legacy_vtk().encode()),
    "mask.nrrd": (functools.partial(problem_from_file, entry=ENTRY, target=TARGET), mask()),
    "q.json": (functools.partial(read_start, robot=table_i_robot()), b"[0, 0, 0, 10, 20, 30, 0, 0]"),
    "plan.npz": (Plan.load, None),
    "mask.nii": (functools.partial(problem_from_file, entry=ENTRY, target=TARGET), None),
}


def good_bytes(name, folder):
    if name == "plan.npz":
        return plan_file(folder).read_bytes()
    if name == "mask.nii":
        image = nibabel.Nifti1Image(voxels().T, np.eye(4))
        image.set_sform(np.eye(4), 2)
        nibabel.save(image, folder / name)
        return (folder / name).read_bytes()
    return READERS[name][1]


@st.composite
def mutations(draw):
    """How to spoil a file: overwrite, drop, repeat or cut bytes, at places given as parts of its length."""
    part = st.floats(0, 1)
    kinds = st.sampled_from(["overwrite", "drop", "repeat", "cut"])
    some = st.tuples(kinds, part, st.integers(1, 12), st.binary(min_size=1, max_size=12))
    return draw(st.lists(some, min_size=1, max_size=4))


def mutated(content, changes):
    for kind, part, count, new in changes:
        at = int(part * len(content))
        if kind == "overwrite":
            content = content[:at] + new + content[at + len(new) :]
        elif kind == "drop":
            content = content[:at] + content[at + count :]
        elif kind == "repeat":
            content = content[: at + count] + content[at:]
        else:
            content = content[:at]
    return content


def read(name, content, folder):
    """Read a file; a CtrError of one line is all that it may raise."""
    path, said = written(folder, name, content), "-"
    try:
        READERS[name][0](path)
    except CtrError as error:
        said = str(error)
    assert len(said.splitlines()) == 1


QUICK = settings(
    max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


@pytest.mark.parametrize("name", READERS)
@QUICK
@given(content=st.binary(max_size=400))
def test_bytes_at_random_are_refused_in_one_line(name, content, tmp_path):
    read(name, content, tmp_path)


@pytest.mark.parametrize("name", READERS)
@QUICK
@given(changes=mutations())
def test_a_good_file_with_a_few_bytes_changed_is_read_or_refused_in_one_line(name, changes, tmp_path):
    read(name, mutated(good_bytes(name, tmp_path), changes), tmp_path)
