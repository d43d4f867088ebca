"""Malformed lists on every list key of every TOML file: each is one clear error or rightly accepted."""

import re

import pytest
from malformed import EXAMPLES, RIG, Said, plan_file, program, spoilt, written

from ctr_nlp import Robot
from ctr_nlp.cli.commands import export
from ctr_nlp.cli.studies import study
from ctr_nlp.exceptions import CtrError, HardwareError
from ctr_nlp.hardware.arm.description import Arm
from ctr_nlp.hardware.description import Hardware
from ctr_nlp.models.loads import read_load
from ctr_nlp.studies.grid.study_file import Study

TEMPLATES = EXAMPLES.parent / "ctr_nlp" / "cli" / "templates"
READERS = {
    "robot.toml": Robot.from_toml,
    "hardware.toml": Hardware.from_toml,
    "load.toml": read_load,
    "study.toml": Study.from_toml,
    "survival.toml": Study.from_toml,
}
MALFORMED = (
    *("[]", "[[]]", "[0, []]", "[[], 0]", "[0, [0, []]]", "[[0, 1], [2]]", "[[0, 1], 2]", "[[[0, 1]]]"),
    *('"x"', '["x"]', '[0, "x"]', "[nan]", "[nan, nan]", "[nan, nan, nan]", "[inf, 0, 0]", "[0, 1e400]"),
    *("[true]", "[true, false, true]", "{}", "{ a = 0 }", "[{}]", "[{ a = 0 }, 1]", "[0, { a = 0 }]"),
    *('[""]', '["a\\u0000b"]', "[[1], 2]", '["x", 1]', "-1"),
    *("1", "true", "1979-05-27", "[1979-05-27]", f"1{'0' * 400}", f"[1{'0' * 400}]", f"[0, 1{'0' * 400}, 0]"),
    f"[{'9' * 5000}]",
)
LIST = re.compile(r"^(?P<off># )?(?P<key>\w+) = (?P<value>\[.*?\]|\[\[.*\]\])(?P<rest>\s*(#.*)?)$")
WITHIN = re.compile(r"(?P<key>\w+) = \[[^\[\]]*\]")
"""A list in a table of one line."""
TABLE = re.compile(r"^# (\[[\w.]+\])\s*(#.*)?$")
GIVEN = {
    "places": ('measures = "tip" ', 'measures = "points" '),
    "distributed_force": ("# between", "between"),
    "between": ("# distributed_force", "distributed_force"),
    "densities": ("# down", "down"),
    "down": ("# densities", "densities"),
}
"""What else changes in a template where a key is given."""


def without_lists(text):
    """Pairs of a label and the text of a template with one of its lists replaced by `VALUE`."""
    lines = text.splitlines()
    table, off = "", False
    for number, line in enumerate(lines):
        if (commented := TABLE.match(line)) or line.startswith("["):
            table, off = (commented[1], True) if commented else (line.split("#")[0].strip(), False)
            opened = number
        found = LIST.match(line)
        one_line = None if found else re.match(r"^(# )?(\w+) = \{", line)
        for key, new in replaced(line, found, one_line):
            changed = list(lines)
            changed[number] = new
            if off:
                changed[opened] = table
                for other in range(opened + 1, number):
                    changed[other] = re.sub(r"^# (\w+ = )", r"\1", changed[other])
            whole = "\n".join(changed) + "\n"
            yield f"{table} {key}", whole.replace(*GIVEN[key]) if key in GIVEN else whole


def replaced(line, found, one_line):
    """Keys of lists in a line, and the line with that list replaced, no longer a comment."""
    if found:
        yield found["key"], f"{found['key']} = VALUE{found['rest']}"
    elif one_line:
        bare = line.removeprefix("# ")
        for inner in WITHIN.finditer(bare):
            yield inner["key"], f"{bare[: inner.start()]}{inner['key']} = VALUE{bare[inner.end() :]}"
        table = re.sub(r"= \{.*\}", "= VALUE", bare)
        yield one_line[2], table


def cases():
    """A label, a reader and a text for every list of every template."""
    for name, reader in READERS.items():
        for number, (label, text) in enumerate(without_lists((TEMPLATES / name).read_text(encoding="utf-8"))):
            yield f"{name} {number}: {label}", reader, text


CASES = list(cases())


@pytest.mark.parametrize(("label", "reader", "text"), CASES, ids=[label for label, *_ in CASES])
def test_a_malformed_list_is_one_clear_error_or_rightly_accepted(label, reader, text, tmp_path):
    bad = {}
    for value in MALFORMED:
        path = written(tmp_path, "file.toml", text.replace("VALUE", value))
        try:
            reader(path)
        except CtrError as error:
            said = str(error)
            assert reader == Study.from_toml or "file.toml" in said, said
            assert len(said.splitlines()) == 1, said
            assert len(said) < 700, said
        except Exception as error:
            bad[value[:30]] = f"{type(error).__name__}: {error}"[:100]
    assert not bad


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("range = [0, 150]  ", "range = [0, []]  ", r"axes, number 1: range is \[0, \[\]\]"),
        ("translation = [0, 0, 0] ", "translation = [0, []] ", r"sensing: translation is \[0, \[\]\]"),
        (
            "# start_joints_deg = [0, -90, 90, 0, 90, 0] ",
            "start_joints_deg = [[0], 1] ",
            "arm: start_joints_deg is",
        ),
        ("approach = 0.2 ", f"approach = 1{'0' * 400} ", "approach is 1000000.*; it must be less than"),
    ],
)
def test_a_command_ends_with_status_2_on_a_malformed_list(old, new, said, tmp_path):
    rig = written(tmp_path, "rig.toml", spoilt(RIG.replace("\nrobot =", "\n# robot ="), old, new))
    with pytest.raises(Said, match=f"^error: hardware file .*rig.toml: {said}"):
        program(export.main, plan_file(tmp_path), "--to", "csv", "--hardware", rig, "--out", tmp_path / "a.csv")
    assert not (tmp_path / "a.csv").exists()


STUDY = """\
[problems]
names = ["arc"]
{}
[[ways]]
models = ["dominant"]
"""


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (
            'files = "a.csv"',
            r"files of problems of a study is 'a\.csv'; it must be a list of texts; .*\['a\.csv'\]",
        ),
        ("files = [1]", "number 1 of files of problems of a study is 1; it must be a text"),
        ("folder = 3", "folder of problems of a study is 3; it must be a text"),
        ("options = 3", "options of problems of a study is 3; it must be a table with the keys branch"),
        ('options = { trimm = "end" }', "key 'trimm' is unknown in options.*Did you mean 'trim'"),
        ("options = { trim = 3 }", "trim of options .* is 3; it must be one of start, end"),
        ("options = { entry = [1, 2] }", r"entry of options .* has shape \(2,\); it must be \(3,\)"),
        ("synthetic = 10000000000", "synthetic of problems of a study is 10000000000; it must be at most"),
        ('[robots]\nfiles = "robot.toml"', "files of robots .* is 'robot.toml'; it must be a list of texts"),
        ("[robots]\nfiles = [[]]", r"number 1 of files of robots of a study is \[\]; it must be a text"),
        ("[robots]\ndrawn = { of = 3, count = 1 }", "of of drawn robots is 3; it must be a text"),
        ("[[ways]]\nsample = { count = 4, ranges = 3 }", "ranges of a sample is 3; it must be a table"),
        ("[[ways]]\nsample = { count = 4 }", "ranges of a sample are empty"),
        (
            '[[ways]]\nsample = { count = 4, ranges = { motion_weight = ["a", "b"] } }',
            r"range of motion_weight is \['a', 'b'\]; it must be numbers",
        ),
    ],
)
def test_a_study_file_of_wrong_types_names_key_and_value(lines, said, tmp_path):
    path = written(tmp_path, "study.toml", STUDY.format(lines))
    with pytest.raises(Said, match=f"^error: study .*study.toml: {said}"):
        program(study.main, path, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "value", [[[1], 2, 3], [1, [2, 3], 4], [[1, 2], [3]], [1, None, 3], {"a": 1}, [10**400] * 3]
)
def test_an_arm_refuses_ragged_lists_from_python(value):
    with pytest.raises(HardwareError, match=r"insertion_point of the arm is .*; it must be 3 numbers"):
        Arm(insertion_point=value)
