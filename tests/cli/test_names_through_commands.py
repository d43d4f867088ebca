"""Problems of any name through every command and export: no traceback, files whole, the name as text."""

import dataclasses
import html
import json
import re
import struct

import baselines
import compare
import pytest
from bench import sweep
from common import UNJUDGED
from malformed import ROBOT, plan, table, written
from scipy.io import loadmat
from view.exchange.test_peer_robots import INNER, OUTER

from ctr_nlp import Plan, Robot, read_robot
from ctr_nlp.cli.commands import export, new, play, report, robust, warm
from ctr_nlp.cli.commands import plan as plan_command
from ctr_nlp.cli.exchange import configurations
from ctr_nlp.cli.loads import contact, force, under
from ctr_nlp.cli.studies import design, study, trade
from ctr_nlp.exceptions import escape_control_characters
from ctr_nlp.studies.grid.study_file import Study

NAMES = {
    "markup": "airway [/left] [red]a[/red] [bold]",
    "tags": "</script><script>alert(1)</script> <b>&amp;</b> <!-- x",
    "quotes": "a'b\"c`d '''e''' \"\"\"f\"\"\"",
    "lines": "one\ntwo\r\nthree\u2028four\x85five",
    "control": "a\x1b[2J\x1b]0;b\x07\x9b31mc\x00d\x7f\x08",
    "bidi": "left\u202eright\u2066x\u2069\u200f",
    "path": "../../etc/passwd",
    "empty": "",
    "long": "long " * 200,
    "surrogate": "a\ud800b\udcff",
    "mathtext": r"$\frac{$ \$x$ $$ ^_",
    "table": "a | b |\t- # * `c`",
    "gcode": "(G28) ; M3 S1000 ! ~ ?) G0 X9",
    "letters": "Bronche gauche é \N{CJK UNIFIED IDEOGRAPH-6C17}\N{CJK UNIFIED IDEOGRAPH-7BA1}",
}


HARD = "markup", "control", "lines", "path", "surrogate", "mathtext"
"""Names for commands that plan, simulate or draw, which takes longer."""


def renamed(found, name):
    """A plan of a problem of that name."""
    meta = dict(found.meta)
    return dataclasses.replace(found, meta=meta | {"problem": dict(meta["problem"]) | {"name": name}})


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """Files of a plan of a problem with a plain name, by format."""
    return exported(tmp_path_factory.mktemp("plain"), "plain")


FORMATS = {
    "csv": "p.csv",
    "gcode": "p.gcode",
    "urscript": "p.script",
    "rosbag2": "bag",
    "slicer": "slicer",
    "gltf": "p.glb",
    "mat": "p.mat",
    "shapes-csv": "s.csv",
}


def exported(folder, name):
    """Export a plan of a problem of that name in every format; the places of the files."""
    renamed(sweep(3, 1.0), name).save(folder / "plan.npz")
    for to, out in FORMATS.items():
        assert export.main([str(folder / "plan.npz"), "--to", to, "--out", str(folder / out)]) == 0
    return {to: folder / out for to, out in FORMATS.items()}


@pytest.fixture
def shown(capsys):
    """What was printed meanwhile, which a terminal shows as it is."""

    def printed():
        told = capsys.readouterr()
        text = told.out + told.err
        assert "Traceback" not in text
        assert all(line.isprintable() for line in text.splitlines())
        return text

    return printed


@pytest.mark.parametrize("kind", NAMES)
def test_exports_of_a_plan_of_any_name_are_whole(kind, plain, tmp_path, shown):
    name = NAMES[kind]
    made = exported(tmp_path, name)
    assert escape_control_characters(name).strip()[:20] in shown()
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*FORMATS.values(), "plan.npz"])
    for to in ("csv", "shapes-csv"):
        assert made[to].read_bytes() == plain[to].read_bytes()
    lines, same = (paths["gcode"].read_text("ascii").splitlines() for paths in (made, plain))
    assert len(lines) == len(same)
    assert [line for line in lines if line[0] != "("] == [line for line in same if line[0] != "("]
    assert all(re.fullmatch(r"\([^()!?~;%]*\)", line) for line in lines if line[0] == "(")
    head, *rest = made["urscript"].read_text("ascii").splitlines()
    assert re.fullmatch(r"def [A-Za-z_][A-Za-z0-9_]*\(\):", head)
    assert rest == plain["urscript"].read_text("ascii").splitlines()[1:]
    for path in plain["slicer"].rglob("*"):
        if path.is_file() and not path.name.startswith("."):
            assert (made["slicer"] / path.relative_to(plain["slicer"])).read_bytes() == path.read_bytes()
    content = made["gltf"].read_bytes()
    assert len(content) == struct.unpack("<I", content[8:12])[0]
    told = json.loads(content[20 : 20 + struct.unpack("<I", content[12:16])[0]])
    assert told["scenes"][0]["name"] == escape_control_characters(name)
    assert "".join(loadmat(made["mat"])["problem"]).rstrip() == escape_control_characters(name).rstrip()
    assert (made["rosbag2"] / "metadata.yaml").is_file()


@pytest.mark.parametrize("kind", NAMES)
def test_the_page_of_plans_of_any_name_shows_it(kind, tmp_path, shown):
    path = tmp_path / "plan.npz"
    renamed(plan(), NAMES[kind]).save(path)
    assert report.main([str(path), str(path), "--out", str(tmp_path / "out")]) == 0
    shown()
    text = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    title = re.search(r"<h1[^>]*>(.*)</h1>", text)
    assert html.unescape(title[1]).startswith(f"{escape_control_characters(NAMES[kind])}: ")
    assert len(re.findall("<script", text)) == 2
    assert text.rstrip().endswith("</html>")


@pytest.mark.parametrize("kind", HARD)
def test_a_problem_of_any_name_is_planned_into_its_own_folder(kind, tmp_path, monkeypatch, shown):
    monkeypatch.chdir(tmp_path)
    source = "from dataclasses import replace\n\nfrom ctr_nlp.problems import named_problem\n\n\n"
    source += "def problem(frames, duration, robot):\n"
    source += f"    return replace(named_problem('arc', frames, duration, robot), name={NAMES[kind]!a})\n"
    written(tmp_path, "mine.py", source)
    asked = "mine.py", "--model", "dominant", "--formulation", "joint", "--frames", "3", *UNJUDGED
    drawn = () if kind in ("mathtext", "control") else ("--no-figures",)
    assert plan_command.plan([*asked, *drawn, "--verbose"]) in (0, 1)
    assert escape_control_characters(NAMES[kind]).strip()[:20] in shown()
    (folder,) = (tmp_path / "runs").iterdir()
    assert Plan.load(folder / "plan.npz").meta["problem"]["name"] == NAMES[kind]
    assert json.loads((folder / "summary.json").read_text())["problem"] == NAMES[kind]
    assert sorted(path.name for path in tmp_path.iterdir() if path.name != "__pycache__") == ["mine.py", "runs"]


LOOKS = {
    "play": (play.main, ("{plan}", "--dry-run", "--uncertified", "--free-space"), "sweep"),
    "robust": (robust.main, ("{plan}", "--draws", "2"), "plan"),
}


@pytest.mark.parametrize("kind", HARD)
@pytest.mark.parametrize("name", LOOKS)
def test_commands_on_a_plan_of_any_name_end_well(name, kind, tmp_path, monkeypatch, shown):
    monkeypatch.chdir(tmp_path)
    command, line, of = LOOKS[name]
    renamed(sweep(3, 1.0) if of == "sweep" else plan(), NAMES[kind]).save(tmp_path / "plan.npz")
    assert command([part.format(plan="plan.npz") for part in line]) in (0, 1)
    shown()
    assert {path.name for path in tmp_path.iterdir()} <= {"plan.npz", "runs"}


@pytest.mark.parametrize("name", ["left[new] [", "$a$ b", "a'b", "a\nb", "a\x1b[31mb", "a{0}b", "a%sb"])
def test_a_centreline_file_of_any_name_is_imported_for(name, tmp_path, monkeypatch, shown):
    monkeypatch.chdir(tmp_path)
    written(tmp_path, f"{name}.csv", table())
    head = [f"{axis}_{'mm' if axis.startswith('beta') else 'rad'}" for axis in plan().robot.axes]
    rows = "\n".join(",".join(map(str, row)) for row in [head, *plan().q.tolist()])
    written(tmp_path, f"{name}.q.csv", rows + "\n")
    asked = f"{name}.q.csv", "--problem", f"{name}.csv", "--model", "dominant", "--no-figures", *UNJUDGED
    assert configurations.main(list(asked)) in (0, 1)
    assert escape_control_characters(name) in shown()


NASTY = "airway [/left] [red]\x1b[2J\n../../x </script> $\\frac{$ 'a\"b (G28) \u202e\ud800"
"""All at once, for commands that take long."""
PROBLEM = """\
from dataclasses import replace

from ctr_nlp.problems import named_problem


def problem(frames, duration, robot):
    return replace(named_problem('arc', frames, duration, robot), name={name!a})
"""


def of_problem(folder, name=NASTY):
    """The file of a problem of that name."""
    return written(folder, "mine.py", PROBLEM.format(name=name)).name


def whole(folder, *given):
    """Whether a command wrote into its own folder alone, and left nothing that it was at work on."""
    partial = re.compile(r"\.ctr_nlp-[0-9a-f]{8}|\..*-[0-9a-f]{8}(\..*)?")
    assert not [path for path in folder.rglob("*") if partial.fullmatch(path.name)]
    assert {path.name for path in folder.iterdir()} <= {*given, "runs", "__pycache__"}
    for path in folder.rglob("*.json"):
        json.loads(path.read_text(encoding="utf-8"))
    for path in folder.rglob("*.html"):
        assert len(re.findall("<script", path.read_text(encoding="utf-8"))) <= 2


MORE = {
    "under": (under.main, ("plan.npz", "--force", "0", "0", "0.01", "--youngs-modulus", "60000", "--no-evaluate")),
    "contact": (contact.main, ("plan.npz", "--youngs-modulus", "60000", "--no-figures")),
    "force": (force.main, ("plan.npz", "--youngs-modulus", "60000", "--every", "4", "--directions", "6")),
}


@pytest.mark.parametrize("name", MORE)
def test_commands_on_loads_take_a_plan_of_any_name(name, tmp_path, monkeypatch, shown):
    monkeypatch.chdir(tmp_path)
    renamed(plan(), NASTY).save(tmp_path / "plan.npz")
    command, line = MORE[name]
    assert command(list(line)) in (0, 1)
    assert "[red]" in shown()
    whole(tmp_path, "plan.npz")


@pytest.mark.real_time
def test_a_plan_of_any_name_is_played(tmp_path, monkeypatch, shown):
    monkeypatch.chdir(tmp_path)
    renamed(sweep(3, 1.0), NASTY).save(tmp_path / "plan.npz")
    argv = ["plan.npz", "--uncertified", "--free-space", "--position-verified"]
    assert play.main(argv) == 0
    assert play.main([*argv[:1], "--replay", *argv[1:3]]) in (1, 2)  # it was no closed loop, and says so
    shown()
    whole(tmp_path, "plan.npz")
    (journal,) = tmp_path.rglob("journal.jsonl")
    assert all(json.loads(line) for line in journal.read_text(encoding="utf-8").splitlines())


def test_a_problem_of_any_name_is_steered(tmp_path, monkeypatch, shown):
    monkeypatch.chdir(tmp_path)
    argv = [of_problem(tmp_path), "--model", "dominant", "--frames", "3", "--no-figures", *UNJUDGED]
    assert plan_command.steer(argv) in (0, 1)
    assert "[red]" in shown()
    whole(tmp_path, "mine.py")


LONG = {
    "design": (design.main, ("--nominal", "--model", "dominant", "--frames", "3", "--starts", "1")),
    "compare": (compare.main, ("--frames", "3", "--variants", "joint:sqp")),
    "trade": (trade.main, ("--frames", "3", "--draws", "2", "--amounts", "0.5", "--margins", "0.3")),
    "baselines": (baselines.main, ("--starts", "1", "--times", "0.1", "--frames", "3")),
    "warm": (warm.main, ("--models", "dominant")),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LONG)
def test_long_commands_take_a_problem_of_any_name(name, tmp_path, monkeypatch, shown):
    monkeypatch.chdir(tmp_path)
    command, line = LONG[name]
    assert command([of_problem(tmp_path), *line]) in (0, 1)
    shown()
    whole(tmp_path, "mine.py")


IN_FILES = "a [red] b", "a'b\"c", "a\nb", "a\rname = 1", "a\x1b[31mb\x7f", "a#b = {", "\u202ea\U0001f600"
"""Parts of names of files, which hold no separators."""


@pytest.mark.parametrize("name", IN_FILES)
def test_a_robot_file_of_any_name_is_made_and_read(name, tmp_path, monkeypatch, shown):
    """From a file of another program whose tubes have such names, too."""
    monkeypatch.chdir(tmp_path)
    tubes = {f"{name} inner": INNER, f"{name} outer": OUTER}
    written(tmp_path, f"{name}.json", json.dumps(tubes))
    assert new.main(["robot", f"{name}.toml", "--from", f"{name}.json"]) == 0
    assert escape_control_characters(name) in shown()
    assert Robot.from_toml(tmp_path / f"{name}.toml") == read_robot(f"{name}.json").robot
    written(tmp_path, f"{name}.toml", ROBOT)
    head = [f"{axis}_{'mm' if axis.startswith('beta') else 'rad'}" for axis in plan().robot.axes]
    rows = "\n".join(",".join(map(str, row)) for row in [head, *plan().q.tolist()])
    written(tmp_path, "q.csv", rows + "\n")
    asked = "q.csv", "--problem", "arc", "--robot", f"{name}.toml", "--model", "dominant", "--no-figures"
    assert configurations.main([*asked, *UNJUDGED]) in (0, 1)
    shown()
    whole(tmp_path, "q.csv", f"{name}.toml", f"{name}.json")


@pytest.mark.parametrize("kind", [kind for kind in NAMES if kind not in ("empty", "surrogate", "control")])
def test_a_study_of_any_name_tells_its_cases(kind, tmp_path, monkeypatch, shown):
    monkeypatch.chdir(tmp_path)
    text = f"name = {json.dumps(NAMES[kind])}\nframes = 3\n[problems]\nnames = ['arc']\n"
    text += '[[ways]]\nmodels = ["dominant"]\nmethods = ["joint"]\n'
    written(tmp_path, "study.toml", text)
    assert study.main(["study.toml", "--only", "no"]) == 2
    shown()
    only = Study.from_toml("study.toml").cases[0].digest
    assert study.main(["study.toml", "--only", only, "--plans"]) in (0, 1)
    shown()
    whole(tmp_path, "study.toml")
