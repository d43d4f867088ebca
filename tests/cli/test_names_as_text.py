"""Text of files, plans and persons is shown as text, and files are written before anything is shown."""

import dataclasses
import io

import pytest
from bench import sweep
from common import UNJUDGED
from malformed import helix, plan, program, table, written
from rich.console import Console

from ctr_nlp.cli import terminal_output
from ctr_nlp.cli.commands import branches, export, play, report, robust
from ctr_nlp.cli.commands import plan as plan_command
from ctr_nlp.cli.exchange import configurations
from ctr_nlp.cli.loads import contact, under
from ctr_nlp.cli.main import main
from ctr_nlp.cli.terminal_output import announce, console, print_table, progress_bar, report_written_files
from ctr_nlp.view.figures.branches import tree
from ctr_nlp.view.figures.overlay import shapes
from ctr_nlp.view.figures.parts.page import label_text

MARKED = "airway [/left] [red]deep[/red] :smile: [link=https://a.b]c[/link]"
OBEYED = "a\x1b[31mb\x1b]0;title\x07\nc\rd\x9b2Je\u202ef\u2066g\x00h\ud800"
ESCAPED = r"a\x1b[31mb\x1b]0;title\x07\nc\rd\x9b2Je\u202ef\u2066g\x00h\ud800"


def saved(found, name, folder):
    """The file of a plan whose problem has that name."""
    path = folder / "plan.npz"
    meta = dict(found.meta)
    dataclasses.replace(found, meta=meta | {"problem": dict(meta["problem"]) | {"name": name}}).save(path)
    return path


@pytest.mark.parametrize(("given", "shown"), [(MARKED, MARKED), (OBEYED, ESCAPED)])
def test_a_terminal_shows_lines_tables_and_files_as_text(given, shown, capsys, monkeypatch):
    monkeypatch.setattr(terminal_output, "PIPED_TABLE_WIDTH", 1000)
    console().print(given)
    announce(given)
    report_written_files(given, [given], more=given)
    print_table(given, ("", given), [(given, given)], text=(given,))
    terminal_output.print_stderr(given)
    told = capsys.readouterr()
    assert told.out.count(shown) == 9
    assert told.err == f"{shown}\n"
    assert all(line.isprintable() for line in told.out.splitlines())


@pytest.mark.parametrize(("given", "shown"), [(MARKED, MARKED), (OBEYED, ESCAPED)])
def test_progress_shows_names_as_text(given, shown, capsys):
    with terminal_output.collect_output(as_json=False, verbose=True), progress_bar() as labelled:
        labelled(given)(2, 2, given)
    told = capsys.readouterr().err
    assert told.count(shown) == 3
    assert all(line.isprintable() for line in told.splitlines())


def test_a_bar_on_a_terminal_shows_names_as_text(monkeypatch):
    seen = io.StringIO()
    real = terminal_output.console
    monkeypatch.setattr(
        terminal_output, "console", lambda stderr=False: type(real())(file=seen, force_terminal=True, width=300)
    )
    assert issubclass(type(real()), Console)
    with progress_bar() as labelled:
        labelled(f"{MARKED} {OBEYED}")
    assert "airway [/left] [red]deep[/red]" in seen.getvalue()
    assert r"a\x1b[31mb" in seen.getvalue()
    assert "a\x1b[31mb" not in seen.getvalue()


def test_an_unknown_argument_is_shown_as_text(capsys):
    with pytest.raises(SystemExit):
        main(["report", "x.npz", "--a\x1b[31m"])
    assert r"--a\x1b[31m" in capsys.readouterr().err


@pytest.mark.parametrize("name", [MARKED, OBEYED])
def test_a_plan_with_markup_in_its_name_is_played_and_exported(name, tmp_path, capsys):
    path = saved(sweep(10), name, tmp_path)
    assert play.main([str(path), "--dry-run", "--free-space", "--uncertified"]) == 0
    assert export.main([str(path), "--to", "csv", "--out", str(tmp_path / "a.csv")]) == 0
    told = capsys.readouterr()
    assert "\x1b" not in told.out + told.err


def test_a_problem_with_markup_in_its_name_is_planned(tmp_path, capsys):
    source = "from ctr_nlp.problems import named_problem\n\n\ndef problem(frames, duration, robot):\n"
    source += "    from dataclasses import replace\n\n"
    source += "    return replace(named_problem('arc', frames, duration, robot), name='airway [/left]')\n"
    out = tmp_path / "out"
    argv = [
        str(written(tmp_path, "mine.py", source)),
        "--model",
        "dominant",
        "--formulation",
        "joint",
        "--frames",
        "3",
        "--no-figures",
    ]
    assert plan_command.plan([*argv, "--out", str(out), *UNJUDGED]) in (0, 1)
    assert "airway [/left]: " in capsys.readouterr().out
    assert (out / "plan.npz").is_file()


def test_branches_of_a_file_with_brackets_in_its_name_are_listed_and_drawn(tmp_path, capsys):
    path = written(tmp_path, "left[new] $a$.csv", table())
    assert branches.main([str(path), "--out", str(tmp_path / "tree.png")]) == 0
    assert "left[new] $a$" in capsys.readouterr().out
    assert (tmp_path / "tree.png").is_file()


class Unshown(Exception):
    """What showing ends in."""


def unshown(*_, **__):
    raise Unshown


def rows_of(folder):
    """Configurations of the plan as a table that `ctr-nlp import` reads."""
    names = plan().robot.axes
    head = [f"{name}_{'mm' if name.startswith('beta') else 'rad'}" for name in names]
    lines = [",".join(head), *(",".join(map(str, q)) for q in plan().q.tolist())]
    written(folder, "path.csv", table())
    return written(folder, "q.csv", "\n".join(lines) + "\n")


COMMANDS = {
    "plan": (plan_command.plan, ("arc", "--model", "dominant", "--frames", "3"), plan_command, "print_report"),
    "robust": (robust.main, ("{plan}", "--draws", "2"), robust, "print_robustness"),
    "under": (under.main, ("{plan}", "--force", "0", "0", "0.01", *("--youngs-modulus", "60000"), *UNJUDGED),
              under, "print_report"),
    "import": (configurations.main, ("{q}", "--problem", "{path}", "--model", "dominant", *UNJUDGED),
               configurations, "print_report"),
    "contact": (contact.main, ("{plan}", "--youngs-modulus", "60000"), contact, "print_table"),
    "branches": (branches.main, ("{path}",), branches, "print_table"),
}  # fmt: skip


@pytest.mark.parametrize("name", COMMANDS)
def test_files_are_written_before_anything_is_shown(name, tmp_path, monkeypatch):
    command, line, module, shows = COMMANDS[name]
    places = {"plan": saved(plan(), "arc", tmp_path), "q": rows_of(tmp_path), "path": tmp_path / "path.csv"}
    out = tmp_path / ("out.png" if name == "branches" else "out")
    line = [part.format(**places) for part in line]
    line += [] if name == "branches" else ["--no-figures"]
    line += list(UNJUDGED) if name == "plan" else []
    monkeypatch.setattr(module, shows, unshown)
    if name == "contact":
        monkeypatch.setattr(contact, "console", unshown)
    with pytest.raises(Unshown):
        program(command, *line, "--out", out)
    assert out.exists()


def test_the_page_of_a_plan_shows_its_name_as_text(tmp_path):
    path = saved(plan(), f"<b>{OBEYED}</b>", tmp_path)
    assert report.main([str(path), "--out", str(tmp_path / "out")]) == 0
    text = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert f"&lt;b&gt;{ESCAPED}&lt;/b&gt;" in text
    assert all(line.isprintable() for line in text.split("<main")[1].split("<script")[0].splitlines())


def test_pictures_show_names_as_text():
    some = plan()
    meta = dict(some.meta) | {
        "problem": dict(some.meta["problem"]) | {"name": r"$\frac$ $x"},
        "solver": "$\n\x1b$",
    }
    some = dataclasses.replace(some, meta=meta)
    for figure in (shapes(some), tree([helix(), helix() + 1], [r"$\frac{$", r"a\$b$"], "$$\n", "LPS")):
        figure.savefig(io.BytesIO(), format="svg")
    assert r"\n\x1b" in shapes(some).texts[0].get_text()
    key = [text for legend in figure.legends for text in legend.get_texts()]
    assert [label_text(r"$\frac{$"), label_text(r"a\$b$")] == [r"\$\frac{\$", r"a\\$b\$"]
    assert key
