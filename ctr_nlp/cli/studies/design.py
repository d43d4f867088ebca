"""`ctr-nlp design`: tubes chosen together with the motions of several problems."""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ctr_nlp.cli import plan_options, problems
from ctr_nlp.cli.arguments import (
    add_compile_option,
    add_figures_option,
    add_numbers,
    add_out_option,
    add_problem_options,
    add_settings,
    settings_from,
    whole,
)
from ctr_nlp.cli.console import INTERRUPTED, SOLVED, Command, console, print_table, progress_bar
from ctr_nlp.cli.output.file import path_component, write_text
from ctr_nlp.cli.output.folder import check_folder, place_of, published
from ctr_nlp.cli.report import exit_status
from ctr_nlp.codesign.plans import planned_on
from ctr_nlp.codesign.rounding import Stocked
from ctr_nlp.codesign.stock import read_stock
from ctr_nlp.codesign.together import STARTS, Design, design
from ctr_nlp.exceptions import OptionError
from ctr_nlp.formulations.shared.manufacture import Manufacture
from ctr_nlp.plan.account import shown
from ctr_nlp.plan.metrics import summary
from ctr_nlp.plan.plan import Plan
from ctr_nlp.support.interrupt import end_if_interrupted
from ctr_nlp.support.pool import side_by_side
from ctr_nlp.support.values import strict_json
from ctr_nlp.target.problem import Problem

DRAWS, SEED = 500, 0
"""Of the robot that every plan is tried on, which neither design nor planning sees."""
RULES = {
    "wall": "least thickness of a tube's wall, mm",
    "channel": "least inner diameter of the innermost tube, mm",
    "outer": "largest outer diameter, mm",
    "clearance": "by how much a tube's inner diameter exceeds the next one's outer diameter, mm",
    "strain_made": "largest strain of a tube when it is bent into its curvature, as a part",
    "strain_deployed": "largest strain of the aligned robot's tubes, as a part",
    "bend_radius": "least radius of any tube's curvature, mm",
}
"""Rules of manufacture, which are options, and what they are."""
COLUMNS = "problem", "with the first tubes", "planned", "mean over draws", "lost", "designed for"


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Choose the tubes of one robot together with its motions along several targets, on the "
        "elastic model: curvatures, lengths of curved parts and diameters, within what can be made of Nitinol. By "
        "default for all robots within the tolerances of the robot file, so that plans survive on robots as "
        "built. Write robot.toml, a plan of every problem, design.json and a drawing sheet (sheet.svg, "
        "sheet.pdf). The lumen's wall does not count.",
        epilog="Exit status: 0 no verdict on a plan is no, 1 one is, 2 bad input, 130 interrupted. `ctr-nlp plan "
        "PROBLEM --robot DIR/robot.toml --model elastic` plans further problems on the robot.",
    )
    kinds = f"{problems.KINDS}, or a folder of centreline files"
    parser.add_argument("problems", metavar="PROBLEM", nargs="+", help=kinds)
    what = "problems that are planned on the designed robot, which is not designed for them, or a folder of them"
    parser.add_argument("--hold-out", metavar="PROBLEM", nargs="+", default=[], help=what)
    parser.add_argument("--nominal", action="store_true", help="leave tolerances out")
    parser.add_argument("--constant-curvature", action="store_true", help="all curved parts are arcs")
    what = "numbers that stay as they are, such as outer_diameter_1 or curved_length_3"
    parser.add_argument("--fix", metavar="NAME", nargs="+", default=[], help=what)
    what = "round the tubes to Nitinol tubing that can be bought, and lengths and curvatures to what can be made; "
    what += "FILE: your own list, with columns part, outer_diameter_mm and inner_diameter_mm (or _in for inches), "
    what += "instead of the package's short one"
    parser.add_argument("--stock", metavar="FILE", nargs="?", const="", help=what)
    what = f"tubes that are started from, the robot's own and random ones (default {STARTS})"
    parser.add_argument("--starts", metavar="N", type=whole, default=STARTS, help=what)
    add_rules(parser)
    parser.add_argument("--jobs", metavar="N", type=whole, default=2, help="processes side by side (default 2)")
    add_out_option(parser, "runs/design")
    add_figures_option(parser)
    add_problem_options(parser)
    add_settings(parser, "a tenth of a plain horizon's", jumps=False)
    plan_options.add_file_options(parser)
    add_compile_option(parser)
    return parser


def add_rules(parser: argparse.ArgumentParser) -> None:
    """Options that say what tubes can be made."""
    defaults = Manufacture()
    group = parser.add_argument_group("what can be made")
    for name, what in RULES.items():
        option = name.replace("_", "-"), "X" if name.startswith("strain") else "MM"
        add_numbers(group, (*option, f"{what} (default {getattr(defaults, name):g})"))


def rules_from(arguments: argparse.Namespace) -> Manufacture:
    """What those options say; raises OptionError."""
    return Manufacture(**{name: value for name in RULES if (value := getattr(arguments, name)) is not None})


def _run(arguments: argparse.Namespace) -> int:
    out = Path(arguments.out)
    tasks, held = (
        [_named(name, problems.load(name, arguments)) for name in problems.expanded(names)]
        for names in (arguments.problems, arguments.hold_out)
    )
    if twice := [name for name, count in Counter(task.name for task in (*tasks, *held)).items() if count > 1]:
        raise OptionError(
            f"two problems are called {twice[0]}; plans are written under these names, rename a file"
        )
    rules, settings = rules_from(arguments), settings_from(arguments, "seed")
    stock = None if arguments.stock is None else read_stock(arguments.stock or None)
    check_folder(out, "design")
    end_if_interrupted()
    with progress_bar() as labelled:
        found = design(
            tasks,
            nominal=arguments.nominal,
            rules=rules,
            fixed=arguments.fix,
            constant_curvature=arguments.constant_curvature,
            starts=arguments.starts,
            jobs=arguments.jobs,
            stock=stock,
            settings=settings,
            progress=labelled("design"),
        )
        plans = list(found.plans)
        if not found.interrupted:
            on = [replace(task, robot=found.robot) for task in held]
            show = labelled("held out")
            plans += planned_on(on, settings, arguments.nominal, jobs=arguments.jobs, progress=show)
            tried = dict(side_by_side(_with_draws, plans, arguments.jobs))
            plans = [tried.get(number, plan) for number, plan in enumerate(plans)]
    place = place_of(out, found.interrupted)
    rows = [_row(found, plan) for plan in plans]
    with published(place, "design") as staging:
        _write(found, plans, rows, staging, arguments)
    _print(found, rows)
    console().print(f"wrote {place}")
    if found.interrupted:
        return INTERRUPTED
    return max((exit_status(plan, tried=not arguments.nominal) for plan in plans), default=SOLVED)


def _with_draws(plan: Plan) -> Plan:
    """The same with draws of its robot, where some of it was reached."""
    return plan.with_draws(DRAWS, SEED) if plan.reached.any() else plan


def _named(name: str, problem: Problem) -> Problem:
    """A problem under the name that its files get."""
    return replace(problem, name=path_component(problem.name or Path(name).stem))


def _write(
    found: Design,
    plans: Sequence[Plan],
    rows: Sequence[dict[str, Any]],
    folder: Path,
    arguments: argparse.Namespace,
) -> None:
    """robot.toml, the plans, design.json and the sheet."""
    title = f"designed for {', '.join(found.names)}"
    write_text(folder / "robot.toml", found.robot.to_toml(f"A robot {title}."))
    for row, plan in zip(rows, plans, strict=True):
        plan.save(folder / f"{row['problem']}.npz")
    told: dict[str, Any] = {
        "problems": list(rows),
        "robot": found.robot.to_dict(),
        "rules": [{f: getattr(rule, f) for f in rule._fields} for rule in found.rules],
        "remarks": [str(remark) for remark in found.remarks],
        "doubts": list(found.doubts),
        "stock": None if found.stocked is None else _stocked(found.stocked),
        "starts": list(found.tried),
        "nominal": arguments.nominal,
        "interrupted": found.interrupted,
    }
    text = json.dumps(strict_json(told), indent=1, allow_nan=False)
    write_text(folder / "design.json", text + "\n")
    if not arguments.no_figures:
        from ctr_nlp.figures import save  # brings matplotlib, which takes long to load
        from ctr_nlp.figures.sheet import sheet

        figure = sheet(found.robot, f"Robot {title}", found.plans)
        for ending in ("svg", "pdf"):
            save(figure, folder / f"sheet.{ending}")


def _stocked(found: Stocked) -> dict[str, Any]:
    return {
        "tubes": [tube._asdict() for tube in found.tubes],
        "e3_free": found.free.tolist(),
        "e3": found.rounded.tolist(),
        "loss": found.loss,
        "tried": found.tried,
    }


def _row(found: Design, plan: Plan) -> dict[str, Any]:
    """What design.json says of a plan."""
    drawn, name = plan.drawn, plan.meta["problem"]["name"]
    own = name in found.names
    return {
        "problem": name,
        "designed_for": own,
        "e3_before": found.before[found.names.index(name)] if own else None,
        "e3": summary(plan)["e3"],
        "mean_over_draws": None if drawn is None or drawn.errors is None else drawn.errors.mean,
        "draws": None if drawn is None else len(drawn),
        "lost": None if drawn is None else drawn.losses,
        "verdicts_no": list(plan.verdicts.failed),
    }


def _print(found: Design, rows: Sequence[dict[str, Any]]) -> None:
    cells = [
        [
            row["problem"],
            *(shown(row[key]) for key in ("e3_before", "e3", "mean_over_draws")),
            "" if row["draws"] is None else f"{row['lost']} of {row['draws']}",
            "yes" if row["designed_for"] else "held out",
        ]
        for row in rows
    ]
    print_table("e3 in mm", list(COLUMNS), cells)
    tubes = [
        [
            *(f"{i + 1}", f"{tube.outer_diameter:.3f}", f"{tube.inner_diameter:.3f}", f"{tube.curved_length:.1f}"),
            *(f"{tube.root_curvature:.5f}", f"{tube.tip_curvature:.5f}"),
        ]
        for i, tube in enumerate(found.robot.tubes)
    ]
    columns = ["tube", "outer mm", "inner mm", "curved part mm", "curvature at root 1/mm", "at tip 1/mm"]
    print_table("tubes", columns, tubes)
    told = () if found.stocked is None else (found.stocked,)
    for remark in (*told, *found.doubts, *found.remarks):
        console().print(f"{remark}.", markup=False)


main = Command("ctr-nlp design", _parser, _run)
