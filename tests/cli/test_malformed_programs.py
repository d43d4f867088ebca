"""Malformed command lines of every program: exit status 2 and one clear line, and nothing is solved or written."""

import copy
import functools
import json

import numpy as np
import pytest
from benchmark import main as benchmark
from compare import main as compare_solvers
from malformed import ROBOT, Case, Said, helix, judge, markups, plan_file, program, spoilt, table, written
from reproduce import main as reproduce_seed

from ctr_nlp.cli.commands.branches import main as list_branches
from ctr_nlp.cli.commands.export import main as export_commands
from ctr_nlp.cli.commands.plan import plan as solve_horizon
from ctr_nlp.cli.commands.plan import steer as solve_per_frame
from ctr_nlp.cli.commands.play import main as play
from ctr_nlp.cli.commands.report import main as make_report

BOTH = [
    ("arc --frames 0", "frames is 0; it must be a whole number of at least 1"),
    ("arc --frames -3", "frames is -3"),
    ("arc --frames 2.5", "'2.5' is not a whole number"),
    ("arc --frames many", "'many' is not a whole number"),
    ("arc --duration 0", "duration is 0.0 s; it must be a finite number > 0"),
    ("arc --duration nan", "duration is nan s"),
    ("arc --duration long", "invalid float value: 'long'"),
    ("nowhere", "problem is 'nowhere'; it must be one of arc, bronchus"),
    ("nowhere.csv", "problem is 'nowhere.csv'; .* an existing centreline file"),
    (".", "problem is '.'"),
    ("../arc", "problem is '../arc'"),
    ("", "the following arguments are required: PROBLEM"),
    ("arc cos", "arc is a named problem, and cos is given after it"),
    ("arc --speling 3", "unrecognized arguments: --speling"),
    ("arc --fraems=5", r"unrecognized arguments: --fraems=5\. Did you mean '--frames'\?"),
    ("bronchsu", r"problem file \(\.py\)\. Did you mean 'bronchus'\?"),
    ("arc --robot nowhere.toml", "robot file nowhere.toml"),
    ("arc --robot {folder}", "robot file .*directory"),
    ("arc --robot {path}", "robot file .*path.csv"),
    ("arc --robot {metres}", "did you mean 90 mm .0.09 m."),
    ("arc --robot {balanced} --model dominant", "tube 1 is not stiffer than tube 2 within it.*--model elastic"),
    ("arc --robot {short}", "the target of arc is 150.00 mm long and the robot reaches 100.00 mm"),
    ("arc --model foo", "invalid choice: 'foo'"),
    ("arc --share 2", r"share is 2.0; it must lie in \(0, 1\]"),
    ("arc --solver foo", "invalid choice: 'foo'"),
    ("arc --robust --model elastic --solver ipopt", "--solver does not go with --robust; leave one of them out"),
    ("arc --most-lost 0.02 --nominal", "--most-lost needs --robust; it sets"),
    ("arc --robust --model elastic --most-lost 0", "most_lost is 0.0; it must be more than 0 and less than 1"),
    ("arc --robust --model elastic --robot {exact}", "all tolerances of the robot are 0"),
    ("arc --stability-margin 1", r"stability_margin is 1.0; it must lie in \[0, 1\), or be None"),
    ("arc --stability-margin -0.1", "stability_margin is -0.1"),
    ("arc --stability-margin much", "'much' is neither a number nor none"),
    ("arc --motion-weight -1", r"motion_weight is -1.0 s\^2"),
    ("arc --motion-weight inf", r"motion_weight is inf s\^2"),
    ("arc --seed -1", "seed is -1; it must be a whole number"),
    ("arc --seed 4294967296", r"seed is 4294967296; it must be a whole number in \[0, 2\^32\)"),
    ("arc --seed one", "'one' is not a whole number"),
    ("arc --start nowhere.json", "configuration nowhere.json cannot be read"),
    ("arc --start {path}", "configuration .*path.csv cannot be read"),
    ("arc --start {short_q}", "short_q.json has 3 numbers; a robot of 3 tubes has 8"),
    ("arc --start {degrees}", "alpha_1 of start .*did you mean 1.571 rad .90 degrees."),
    ("arc --start {outside}", r"beta_3 of start is 300 mm; it must lie in \[0, 150\]"),
    ("arc --trim start", "--trim goes with a centreline file or a mask; arc is a named problem"),
    ("arc --tilt 10", "--tilt goes with a centreline file"),
    ("arc --clearance 0.1", "clearance is asked for, and arc has no lumen radii"),
    ("bronchus --clearance -1", "clearance is -1.0; it must be a finite number >= 0"),
    ("bronchus --contact-weight nan", "contact_weight is nan"),
    ("arc --film {folder}/film.avi", "film.avi.*gif|gif"),
    ("arc --film {folder}", "gif|folder"),
    ("arc --out {path}", "output folder .*path.csv"),
    ("arc --out {mine}", "mine"),
    ("arc --out /proc/nowhere", "output folder /proc/nowhere cannot be written"),
    ("{path} --trim middle", "invalid choice: 'middle'"),
    ("{path} --branch 7", "branch is '7'; there is none of that name or number"),
    ("{path} --entry 1 2", "expected 3 arguments"),
    ("{path} --entry 1 2 x", "invalid float value: 'x'"),
    ("{path} --entry 900 0 0", "entry .900, 0, 0. is .* mm away from branch"),
    ("{path} --insertion 0 0 0", "insertion direction is .*not all of them 0"),
    ("{path} --insertion 0 0 -1", "degrees away from where the path leads"),
    ("{path} --tilt -5", "tilt is -0.08.* rad, -5 degrees"),
    ("{path} --tilt 500", "tilt is 8.7.* rad, 500 degrees"),
    ("{path} --smoothing -1", "smoothing is -1.0 mm"),
    ("{path} --smoothing nan", "smoothing is nan mm"),
    ("{long}", "--trim start moves .* mm inwards, --trim end stops"),
    ("{curves}", "there are 2 branches, .*choose one by number or name"),
    ("{broken}", "is not a centreline"),
]
PER_FRAME = [
    ("arc --formulation foo", "invalid choice: 'foo'"),
    ("arc --formulation two-stage --model elastic", "two-stage formulations need 'dominant'"),
    ("arc --direction up", "invalid choice: 'up'"),
    ("arc --direction backward --start {q}", "direction is 'backward' and a start is given"),
    ("arc --jump-width 0", "jump_width is 0.0 mm"),
]
HORIZON = [
    ("bronchus --arrival-weight -0.1", "arrival_weight is -0.1"),
    ("arc --frames 1", "frames is 1; a motion over a horizon needs at least 2"),
    ("arc --starts 0", "starts is 0"),
    ("arc --jobs -1", "jobs is -1"),
    ("arc --initial nowhere.npz", "plan nowhere.npz cannot be read"),
    ("arc --initial {path}", "path.csv is not a plan"),
    ("arc --initial {plan}", r"a motion of initial has shape \(4, 8\); it must be \(100, 8\)"),
    ("arc --end {short_q}", "short_q.json has 3 numbers"),
    ("arc --speed 1 2", "expected 3 arguments"),
    ("arc --speed 0 90 0.8", "speed of alpha_1 is 0; it must be positive"),
    ("arc --acceleration 1 -1 1", "acceleration of beta_1 is -1"),
    ("arc --duration 0.5", "beta_3 may slide at 90 mm/s"),
    ("arc --sweep-motion-weight 1e-5 -2", r"motion_weight is -2.0 s\^2"),
]
OTHERS = [
    (compare_solvers, "nowhere", "problem is 'nowhere'"),
    (compare_solvers, "arc --variants foo", "variant is 'foo'; it must be one of"),
    (compare_solvers, "arc --variants joint:foo", "solver of variant 'joint:foo' is 'foo'"),
    (compare_solvers, "arc --variants foo:sqp", "formulation of variant 'foo:sqp' is 'foo'"),
    (compare_solvers, "arc --variants joint:ipopt:foo", "model of variant"),
    (compare_solvers, "arc --variants two-stage:ipopt:elastic", "two-stage formulations need 'dominant'"),
    (compare_solvers, "arc --variants euclidean tip-jacobian --robot {balanced}", "is not stiffer"),
    (compare_solvers, "arc --frames 0", "frames is 0"),
    (compare_solvers, "arc --out {mine}", "mine"),
    (reproduce_seed, "--frames 0", "frames is 0"),
    (reproduce_seed, "--jobs 0", "jobs is 0"),
    (reproduce_seed, "--only fig99", "invalid choice: 'fig99'"),
    (reproduce_seed, "--out {path}", "path.csv"),
    (benchmark, "--parts foo", "invalid choice: 'foo'"),
    (benchmark, "--rows foo", "invalid choice: 'foo'"),
    (benchmark, "--json {folder}", "--json is .*; it must be a file in a folder that exists"),
    (benchmark, "--json /nowhere/at/all.json", "--json is /nowhere/at/all.json"),
]
ALONE = [
    (list_branches, "nowhere.csv", "nowhere.csv cannot be read"),
    (list_branches, "{folder}", "is not a known kind of file"),
    (list_branches, "{broken}", "is not a centreline"),
    (list_branches, "{plan}", "is not a known kind of file"),
    (list_branches, "{path} --out {folder}/tree.gif", "the picture's name must end in .png"),
    (list_branches, "{path} --out {picture}", "exists and is not a picture"),
    (list_branches, "{path} --entry nan 0 0", "entry is .nan, 0, 0.; it must be three finite numbers"),
    (list_branches, "", "the following arguments are required: FILE"),
    (make_report, "nowhere.npz", "plan nowhere.npz cannot be read"),
    (make_report, "{path}", "path.csv is not a plan"),
    (make_report, "{plan} --out {mine}", "mine"),
    (make_report, "{plan} --film {folder}/film.avi --out {folder}/report", "gif"),
    (make_report, "{plan} {broken} --out {folder}/report", "broken.csv is not a plan"),
    (make_report, "", "the following arguments are required: PLAN.npz"),
    (export_commands, "{plan}", "the following arguments are required: --to"),
    (export_commands, "{plan} --to foo", "invalid choice: 'foo'"),
    (export_commands, "nowhere.npz --to csv", "plan nowhere.npz cannot be read"),
    (export_commands, "{path} --to csv --out {folder}/x.csv", "path.csv is not a plan"),
    (export_commands, "{plan} --to csv --tempo 0", "tempo is 0"),
    (export_commands, "{plan} --to csv --tempo 2", "tempo is 2"),
    (export_commands, "{plan} --to csv --tempo nan", "tempo is nan"),
    (export_commands, "{plan} --to csv --hardware nowhere.toml", "hardware file nowhere.toml"),
    (export_commands, "{plan} --to csv --hardware {path}", "hardware file .*path.csv"),
    (export_commands, "{plan} --to csv --storage mcap", "--storage goes with --to rosbag2"),
    (export_commands, "{plan} --to rosbag2 --out {folder}/bag.mcap", "but a bag is a folder"),
    (export_commands, "{plan} --to csv --out {notes}", "exists and was not written by ctr-nlp"),
    (export_commands, "{jumping} --to csv", "changes by"),
    (export_commands, "{unsolved} --to csv", "the plan has no solution; all frames must be solved"),
    (export_commands, "{lying} --to csv", "shape is .* mm from that of its configuration"),
    (play, "nowhere.npz", "plan nowhere.npz cannot be read"),
    (play, "{path}", "path.csv is not a plan"),
    (play, "{plan} --dry-run --tempo 0", "tempo is 0"),
    (play, "{plan} --dry-run --tempo -1", "tempo is -1"),
    (play, "{plan} --dry-run --hardware nowhere.toml", "hardware file nowhere.toml"),
    (play, "{plan} --resume --home", "--home does not go with --resume"),
    (play, "{plan} --resume --tempo 0.5", "--tempo does not go with --resume"),
    (play, "{plan} --resume --dry-run", "--dry-run does not go with --resume"),
    (play, "{plan} --live --dry-run", "--live does not go with --dry-run"),
    (play, "{plan} --resume --out {folder}/nothing", "journal"),
    (play, "{jumping} --dry-run", "changes by"),
    (play, "{unsolved} --dry-run", "the plan has no solution; all frames must be solved"),
    (play, "{one} --dry-run", "a plan of 1 frames is no motion"),
]  # fmt: skip
ACCEPTED = [
    (list_branches, "{path}", "a good file"),
    (list_branches, "{curves} --reverse", "two branches are a list"),
    (export_commands, "{plan} --to csv --out {folder}/commands.csv", "a good plan"),
    (play, "{plan} --dry-run --uncertified", "a good plan"),
]
BALANCED = """
[[tubes]]
length = 200
curved_length = 100
curvature = 0.01
outer_diameter = 2.4
inner_diameter = 2.2
[[tubes]]
length = 300
curved_length = 150
curvature = 0.012
outer_diameter = 2.0
inner_diameter = 1.0
"""


def scene(folder):
    """Files to name on command lines, by what they are."""
    twice = markups()
    beside = copy.deepcopy(twice["markups"][0])
    for control in beside["controlPoints"]:
        control["position"][0] += 40.0
    twice["markups"].append(beside)
    texts = {
        "path.csv": table(), "long.csv": table(helix() * 3), "broken.csv": "x,y\n1,2\n",
        "notes.csv": "my own notes\n",
        "picture.png": "my own picture\n",
        "curves.mrk.json": json.dumps(twice), "balanced.toml": BALANCED,
        "metres.toml": spoilt(ROBOT, "length = 90 ", "length = 0.09 "),
        "exact.toml": BALANCED + "[tolerances]\ncurvature = 0\nbending_stiffness = 0\nmotor_zero = 0\n",
        "short.toml": spoilt(ROBOT, "[0, 150]]", "[0, 100]]"),
        "short_q.json": "[0, 0, 0]", "q.json": "[0, 0, 0, 1, 1, 1, 0, 0]",
        "degrees.json": "[90, 0, 0, 1, 1, 1, 0, 0]", "outside.json": "[0, 0, 0, 1, 1, 300, 0, 0]",
    }  # fmt: skip
    found = {name.partition(".")[0]: written(folder, name, text) for name, text in texts.items()}
    mine = folder / "mine"
    mine.mkdir()
    written(mine, "thesis.tex", "years of work")
    return found | {"folder": folder, "mine": mine} | plans(folder)


def plans(folder):
    """Plans, good and changed after they were made."""
    made = {}
    good = np.load(plan_file(folder), allow_pickle=False)
    alpha, shape, success = (good[name].copy() for name in ("alpha", "shape", "success"))
    alpha[2], shape[1], success[3] = 9.0, shape[1] + 1, False
    first = {name: good[name][:1] for name in good.files if name not in ("to_robot", "lumen", "meta")}
    spoilt_so = {"jumping": {"alpha": alpha}, "lying": {"shape": shape}, "unsolved": {"success": success}}
    for name, changes in (spoilt_so | {"one": first, "plan": {}}).items():
        made[name] = plan_file(folder, **changes).rename(folder / f"{name}.npz")
    return made


def command(folder, main, line):
    """Run a program with a line's arguments, files named in braces."""
    return program(main, *line.format(**scene(folder)).split())


def cases():
    """All of the table."""
    rows = [(main, line, message) for main in (solve_per_frame, solve_horizon) for line, message in BOTH]
    rows += [(solve_per_frame, line, message) for line, message in PER_FRAME]
    rows += [(solve_horizon, line, message) for line, message in HORIZON]
    rows += [*OTHERS, *ALONE]
    for main, line, message in rows:
        run = functools.partial(command, main=main, line=line)
        yield Case(f"{main.name} {line}", run, Said, message)
    for main, line, why in ACCEPTED:
        run = functools.partial(command, main=main, line=line)
        yield Case(f"{main.name} {line}", run, None, why)


CASES = list(cases())


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_malformed_command_line_is_one_clear_line_and_writes_nothing(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    judge(case, tmp_path)
    assert not (tmp_path / "runs").exists()
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.tex"]
