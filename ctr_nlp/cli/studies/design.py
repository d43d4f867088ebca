"""`ctr-nlp design`: tubes chosen together with the motions of several problems."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

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
from ctr_nlp.codesign.rounding import Stocked
from ctr_nlp.codesign.stock import read_stock
from ctr_nlp.codesign.together import STARTS, Design, design, planned_on
from ctr_nlp.formulations.shared.manufacture import Manufacture
from ctr_nlp.plan.metrics import summary
from ctr_nlp.plan.plan import Plan
from ctr_nlp.support.interrupt import end_if_interrupted
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
    parser.add_argument("problems", metavar="PROBLEM", nargs="+", help=problems.KINDS)
    what = "problems that are planned on the designed robot, which is not designed for them"
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
    defaults = Manufacture()
    group = parser.add_argument_group("what can be made")
    for name, what in RULES.items():
        option = name.replace("_", "-"), "X" if name.startswith("strain") else "MM"
        add_numbers(group, (*option, f"{what} (default {getattr(defaults, name):g})"))
    add_out_option(parser, "runs/design")
    add_figures_option(parser)
    add_problem_options(parser)
    add_settings(parser, "a tenth of a plain horizon's", jumps=False)
    plan_options.add_file_options(parser)
    add_compile_option(parser)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    out = Path(arguments.out)
    asked = [*arguments.problems, *arguments.hold_out]
    loaded = [_named(name, problems.load(name, arguments)) for name in asked]
    tasks, held = loaded[: len(arguments.problems)], loaded[len(arguments.problems) :]
    given = {name: value for name in RULES if (value := getattr(arguments, name)) is not None}
    rules, settings = Manufacture(**given), settings_from(arguments, "seed")
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
            stock=stock,
            settings=settings,
            progress=labelled("design"),
        )
        plans = list(found.plans)
        if not found.interrupted:
            show = labelled("held out")
            for number, task in enumerate(held):
                show(number, len(held), task.name)
                plans.append(planned_on(replace(task, robot=found.robot), settings, arguments.nominal))
    if not found.interrupted:
        plans = [plan.with_draws(DRAWS, SEED) if plan.reached.any() else plan for plan in plans]
    place = place_of(out, found.interrupted)
    names = [task.name for task in loaded][: len(plans)]
    with published(place, "design") as staging:
        _write(found, plans, names, staging, arguments)
    _print(found, plans, names)
    console().print(f"wrote {place}")
    if found.interrupted:
        return INTERRUPTED
    return max((exit_status(plan, tried=not arguments.nominal) for plan in plans), default=SOLVED)


def _named(name: str, problem: Problem) -> Problem:
    """A problem under the name that its files get."""
    return replace(problem, name=path_component(problem.name or Path(name).stem))


def _write(
    found: Design, plans: Sequence[Plan], names: Sequence[str], folder: Path, arguments: argparse.Namespace
) -> None:
    """robot.toml, the plans, design.json and the sheet."""
    title = f"designed for {', '.join(found.names)}"
    write_text(folder / "robot.toml", found.robot.to_toml(f"A robot {title}."))
    for name, plan in zip(names, plans, strict=True):
        plan.save(folder / f"{name}.npz")
    told: dict[str, Any] = {
        "problems": [_row(found, plan, name) for name, plan in zip(names, plans, strict=True)],
        "robot": found.robot.to_dict(),
        "rules": [{f: getattr(rule, f) for f in rule._fields} for rule in found.rules],
        "remarks": [str(remark) for remark in found.remarks],
        "doubts": list(found.doubts),
        "stock": None if found.stocked is None else _stocked(found.stocked),
        "starts": list(found.tried),
        "nominal": arguments.nominal,
        "interrupted": found.interrupted,
    }
    text = json.dumps(_finite(strict_json(told)), indent=1, allow_nan=False)
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


def _finite(value: Any) -> Any:
    """The same with null for what is not known."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and np.isnan(value) else value


def _row(found: Design, plan: Plan, name: str) -> dict[str, Any]:
    """What design.json says of a plan."""
    drawn, own = plan.drawn, name in found.names
    return {
        "problem": name,
        "designed_for": own,
        "e3_before": float(found.before[found.names.index(name)]) if own else None,
        "e3": summary(plan)["e3"],
        "mean_over_draws": None if drawn is None or drawn.errors is None else drawn.errors.mean,
        "draws": None if drawn is None else len(drawn),
        "lost": None if drawn is None else drawn.losses,
        "verdicts_no": list(plan.verdicts.failed),
    }


def _print(found: Design, plans: Sequence[Plan], names: Sequence[str]) -> None:
    rows = [_row(found, plan, name) for name, plan in zip(names, plans, strict=True)]
    shown = [
        [
            row["problem"],
            *(_mm(row[key]) for key in ("e3_before", "e3", "mean_over_draws")),
            "" if row["draws"] is None else f"{row['lost']} of {row['draws']}",
            "yes" if row["designed_for"] else "held out",
        ]
        for row in rows
    ]
    print_table("e3 in mm", list(COLUMNS), shown)
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


def _mm(value: float | None) -> str:
    return "" if value is None or not np.isfinite(value) else f"{value:.3g}"


main = Command("ctr-nlp design", _parser, _run)
