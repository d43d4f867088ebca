"""What programs tell, for people and as JSON, and the examples in their help."""

import io
import json
import re
import shlex
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from bench import sweep
from common import UNJUDGED

from ctr_nlp.cli import terminal_output
from ctr_nlp.cli.console import examples
from ctr_nlp.cli.main import COMMANDS, load, main
from ctr_nlp.cli.terminal_output import (
    busy,
    collect_output,
    console,
    print_table,
    progress_bar,
    report_written_files,
)
from ctr_nlp.plan.summary_text import NOT_FOR_PATIENTS


@pytest.mark.parametrize("name", COMMANDS)
def test_every_help_ends_with_two_examples_that_the_command_takes(name):
    parser, given = load(COMMANDS[name]).parser(f"ctr-nlp {name}"), examples(name)
    assert len(given) >= 2
    lines = parser.format_help().splitlines()
    for what, call in given:
        assert what.endswith(":")
        assert lines[lines.index(f"  {what}") + 1] == f"    ctr-nlp {name} {call}".rstrip()
        parser.parse_args(shlex.split(call))  # ends the program where an argument is wrong


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_tells_what_it_does_and_tells_it_as_json(name):
    options = load(COMMANDS[name]).parser(f"ctr-nlp {name}").format_help()
    assert "--json" in options
    assert "--verbose" in options


PLAN = "plan", "arc", "--model", "dominant", "--frames", "3", "--no-figures", *UNJUDGED


def test_a_plan_tells_as_json_what_it_wrote_and_found(tmp_path, capsys):
    out = tmp_path / "out"
    assert (
        main(
            [
                "plan",
                "arc",
                "--model",
                "dominant",
                "--frames",
                "3",
                "--no-figures",
                "--out",
                str(out),
                "--json",
                *UNJUDGED,
            ]
        )
        == 0
    )
    told = json.loads(capsys.readouterr().out)
    assert (told["command"], told["exit_status"], told["error"]) == ("ctr-nlp plan", 0, None)
    assert sorted(told["files"]) == sorted(str(path) for path in out.iterdir() if not path.name.startswith("."))
    assert told["tables"]
    for table in told["tables"]:
        assert {len(row) for row in table["rows"]} == {len(table["columns"])}


def test_without_it_the_same_is_told_in_words(tmp_path, capsys):
    assert (
        main(
            [
                "plan",
                "arc",
                "--model",
                "dominant",
                "--frames",
                "3",
                "--no-figures",
                "--out",
                str(tmp_path / "out"),
                *UNJUDGED,
            ]
        )
        == 0
    )
    told = capsys.readouterr().out
    assert f"wrote {tmp_path / 'out'}: errors.csv, plan.npz, summary.json" in told.splitlines()
    assert "{" not in told


def test_an_error_is_told_as_json_and_on_stderr(capsys):
    assert main(["branches", "nothing.csv", "--json"]) == 2
    told = capsys.readouterr()
    found = json.loads(told.out)
    assert found["exit_status"] == 2
    assert "nothing.csv" in found["error"]
    assert told.err == f"error: {found['error']}\n"
    assert found["files"] == found["tables"] == found["lines"] == []


def test_numbers_stay_numbers_and_what_is_not_finite_is_null():
    with collect_output(as_json=True, verbose=False) as told:
        print_table("numbers", ("", "value"), [("one", np.float64(1.25)), ("none", float("nan")), ("all", True)])
        console().print("a line that is " + "long " * 100)
        report_written_files("folder", ["a.csv", "b.csv"])
        report_written_files("c.csv", more="; open it")
    assert told is not None
    found = json.loads(told.as_json(command="x"))
    assert found["tables"][0]["rows"] == [["one", 1.25], ["none", None], ["all", True]]
    assert len(found["lines"]) == 1
    assert found["files"] == ["folder/a.csv", "folder/b.csv", "c.csv"]


def test_verbose_tells_on_stderr_how_far_the_work_is(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(terminal_output, "LONGEST_SILENCE_S", 1e6)  # lines come with --verbose alone
    arguments = [
        "steer",
        "arc",
        "--model",
        "dominant",
        "--frames",
        "4",
        "--no-figures",
        "--out",
        str(tmp_path / "out"),
        *UNJUDGED,
    ]
    assert main([*arguments, "--verbose"]) == 0
    told = re.compile(r"^ +\d+\.\d s  arc: \w.*, \d+ of \d+(, about \d+ s left)?$", re.MULTILINE)
    assert told.search(capsys.readouterr().err)
    assert main(arguments) == 0
    assert not told.search(capsys.readouterr().err)


def test_a_log_gets_a_line_where_there_was_none_for_long(capsys, monkeypatch):
    monkeypatch.setattr(terminal_output, "LONGEST_SILENCE_S", 0.0)
    with collect_output(as_json=True, verbose=False), progress_bar() as labelled:
        labelled("pictures are drawn")(1, 4, "errors")
    found = capsys.readouterr()
    assert re.search(r"^ +\d+\.\d s  pictures are drawn$", found.err, re.MULTILINE)
    assert re.search(r"^ +\d+\.\d s  pictures are drawn: errors, 1 of 4", found.err, re.MULTILINE)
    assert found.out == ""


def test_a_log_gets_a_line_while_a_step_reports_nothing(capsys, monkeypatch):
    monkeypatch.setattr(terminal_output, "LONGEST_SILENCE_S", 0.1)
    seen = ""
    with busy("the mask is read"):
        while "the mask is read" not in seen:
            time.sleep(0.05)
            seen += capsys.readouterr().err


def test_work_goes_on_where_the_log_is_not_read_any_more(monkeypatch):
    class Closed(io.StringIO):
        def write(self, text):
            raise BrokenPipeError

    monkeypatch.setattr(terminal_output, "LONGEST_SILENCE_S", 0.0)
    monkeypatch.setattr(sys, "stderr", Closed())
    with progress_bar() as labelled:
        labelled("pictures are drawn")(4, 4, "errors")


def test_a_short_command_prints_no_progress_in_a_log(capsys, monkeypatch):
    monkeypatch.setattr(terminal_output, "LONGEST_SILENCE_S", 1e6)
    with progress_bar() as labelled:
        labelled("pictures are drawn")(4, 4, "errors")
    assert capsys.readouterr().err == ""


def test_a_bar_counts_known_steps_and_times_others(monkeypatch):
    seen = io.StringIO()
    terminal = type(console())(file=seen, force_terminal=True, width=100)
    monkeypatch.setattr(terminal_output, "console", lambda stderr=False: terminal)
    with progress_bar() as labelled:
        labelled("the mask is read")
        labelled("pictures")(1, 4, "errors")
    bars = [line for line in re.split(r"[\r\n]+", re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", seen.getvalue())) if line]
    assert not [line for line in bars if "?" in line]
    assert any(re.fullmatch(r"the mask is read ━+ +0:00:\d\d *", line) for line in bars)
    assert any(re.match(r"pictures: errors [━╸╺]+ 1/4 0:00:\d\d", line) for line in bars)
    assert max(map(len, bars)) <= 100


def test_no_command_at_all_lists_the_commands(capsys):
    with pytest.raises(SystemExit) as ended:
        main([])
    assert ended.value.code == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert set(COMMANDS) <= set(told.err.split())
    assert told.err.endswith("error: no command was given; the list above says what each one does\n")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("json_too", [(), ("--json",)], ids=["text", "json"])
def test_a_full_standard_output_is_one_line_and_status_1(json_too, tmp_path):
    sweep(3, 1.0).save(tmp_path / "plan.npz")
    command = "play", "plan.npz", "--dry-run", "--uncertified", "--free-space", *json_too
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "ctr_nlp", *command],
            cwd=tmp_path,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
        )
    assert done.returncode == 1
    errors = [line for line in done.stderr.splitlines() if not line.startswith(("note: ", NOT_FOR_PATIENTS))]
    assert errors == ["error: standard output cannot be written: No space left on device"]
