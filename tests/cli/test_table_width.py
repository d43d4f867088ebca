"""Tables of every command fit 100 columns, on a terminal and in a pipe."""

import ast
import importlib

import numpy as np
import pytest
from common import ROOT, named_problem

from ctr_nlp import solve_per_frame
from ctr_nlp.cli.main import COMMANDS, load
from ctr_nlp.cli.terminal_output import console, print_table

WIDTH = 100


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    """A plan in a file."""
    path = tmp_path_factory.mktemp("plan") / "plan.npz"
    solve_per_frame(named_problem("arc", frames=4), model="dominant").save(path)
    return path


@pytest.fixture
def centreline(tmp_path):
    t = np.linspace(0, 140, 141)
    path = tmp_path / "a_file_with_a_name_of_middle_length.csv"
    table = np.column_stack([t - 170, 5 * (1 - np.cos(t / 50)) - 160, 0 * t - 200, np.full(141, 4.0)])
    np.savetxt(path, table, delimiter=",", header="x_mm,y_mm,z_mm,radius_mm", comments="")
    return path


def tables(text):
    """The lines of printed tables: each from the line of its columns to the empty line that ends it."""
    found, lines = [], text.splitlines()
    for k, line in enumerate(lines):
        if line.strip() and set(line.strip()) == {"─"}:
            first = k
            while first and lines[first - 1].strip():
                first -= 1
            last = next((m for m in range(k, len(lines)) if not lines[m].strip()), len(lines))
            found.append(lines[first:last])
    return found


CALLS = {
    "branches": "branches CENTRELINE",
    "inspect": "inspect CENTRELINE",
    "plan": "steer arc --model dominant --frames 3 --no-evaluate --no-figures --out OUT",
    "check": "check PLAN",
    "robust": "robust PLAN --evaluate dominant --draws 3 --out OUT",
    "doctor": "doctor",
}
"""Calls that take a second, by the commands whose tables they print."""


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_tables_fit_a_terminal_of_100_columns(call, plan, centreline, tmp_path, capsys):
    places = {"PLAN": plan, "CENTRELINE": centreline, "OUT": tmp_path / "out"}
    name, *words = [str(places.get(word, word)) for word in call.split()]
    load(COMMANDS[name])(words)
    found = tables(capsys.readouterr().out)
    assert found
    assert max(len(line) for table in found for line in table) <= WIDTH


def columns_of_tables():
    """The names of the columns of every table that commands print, by file and line, where the code names them."""
    for path in sorted((ROOT / "ctr_nlp" / "cli").rglob("*.py")):
        module = importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "print_table":
                code = compile(ast.Expression(node.args[1]), str(path), "eval")
                try:
                    yield f"{path.name}:{node.lineno}", list(eval(code, vars(module)))
                except (NameError, TypeError):
                    continue  # made of what a run finds


@pytest.mark.parametrize("columns", [pytest.param(one, id=name) for name, one in columns_of_tables()])
def test_no_word_of_a_heading_is_broken_at_100_columns(columns, capsys):
    print_table("title", columns, [["1234.5"] * len(columns)])
    words = capsys.readouterr().out.split()
    for column in columns:
        assert set(column.split()) <= set(words)


def test_most_tables_name_their_columns_in_the_code():
    assert len(list(columns_of_tables())) > 15


def test_coordinates_stay_on_one_line_and_text_wraps_between_words(capsys):
    rows = [[f"{k}", "-154.9 -176.5 -106.3", "a remark of many words " * 6] for k in range(2)]
    print_table("title", ("number", "place", "remark"), rows, text=("remark",), unbroken=("place",))
    out = capsys.readouterr().out
    assert out.count("-154.9 -176.5 -106.3") == 2
    assert set(out.split()) - {"title", "number", "place", "remark", "0", "1"} <= {
        *["-154.9", "-176.5", "-106.3", "a", "remark", "of", "many", "words"],
        next(word for word in out.split() if set(word) == {"─"}),
    }
    assert max(map(len, out.splitlines())) <= WIDTH


def test_a_title_and_sentences_are_never_broken(capsys):
    file = "/home/somebody/scans of the chest/" + "a_name_" * 20 + "mask.nii.gz"
    print_table(file, ("what", "value"), [["kind", "mask"]], text=("value",))
    console().print(f"wrote {file}")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == file
    assert lines[-1] == f"wrote {file}"


def test_a_table_that_cannot_fit_breaks_words_and_loses_none(capsys):
    print_table("title", [f"column{k}" for k in range(20)], [[f"word{k:02d}" for k in range(20)]])
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= WIDTH
    letters = sorted(out)
    assert all(letters.count(digit) >= 2 for digit in "0123456789")
