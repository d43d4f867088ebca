"""Files and tables of `ctr-nlp design`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctr_nlp.cli.output.file import write_text
from ctr_nlp.cli.plan_report import STYLES
from ctr_nlp.cli.terminal_output import console, print_table
from ctr_nlp.plan.metrics import summary
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.robustness import Robustness
from ctr_nlp.plan.summary_text import format_cell
from ctr_nlp.plan.verdicts import SHORT_NAMES
from ctr_nlp.support.value_checks import strict_json
from ctr_nlp.tube_design.co_design import Design
from ctr_nlp.tube_design.leave_one_out import HeldOutEnd
from ctr_nlp.tube_design.rounding import StockRounding

DESIGN_TABLE_COLUMNS = (
    *("problem", "first tubes", "planned", "samples", "failed", "as sold", "failed", "designed for"),
)


@dataclass(frozen=True)
class EvaluatedPlan:
    """A plan, and its robustness on tubing as sold; None where that is not known."""

    plan: Plan
    robustness_as_sold: Robustness | None = None


@dataclass(frozen=True)
class DesignWithPlans:
    """A design, and all plans on its robot: of the problems that it was designed for, then of others."""

    design: Design
    evaluated_plans: tuple[EvaluatedPlan, ...]


def write_designs(designs: Sequence[DesignWithPlans], folder: Path, nominal: bool, figures: bool) -> None:
    """Write robot.toml, the plans, design.json and the sheet of each design, in a folder for each where there are
    several.

    designs: the designs with their plans. folder: an existing folder. nominal: whether tolerances were left out.
    figures: whether to draw the sheet.
    """
    for number, one in enumerate(designs, start=1):
        place = folder / f"robot_{number}" if len(designs) > 1 else folder
        place.mkdir(exist_ok=True)
        _write_design(one, place, nominal, figures)


def _write_design(design: DesignWithPlans, folder: Path, nominal: bool, figures: bool) -> None:
    found = design.design
    title = f"designed for {', '.join(design.design.names)}"
    write_text(folder / "robot.toml", found.robot.to_toml(f"A robot {title}."))
    rows = [_row(found, one) for one in design.evaluated_plans]
    for row, one in zip(rows, design.evaluated_plans, strict=True):
        one.plan.save(folder / f"{row['problem']}.npz")
    told: dict[str, Any] = {
        "problems": rows,
        "robot": found.robot.to_dict(),
        "rules": [{f: getattr(rule, f) for f in rule._fields} for rule in found.rules],
        "remarks": [str(remark) for remark in found.remarks],
        "doubts": list(found.warnings),
        "stock": None if found.stock_rounding is None else _stock_entry(found.stock_rounding),
        "starts": list(found.start_results),
        "nominal": nominal,
        "interrupted": found.interrupted,
    }
    text = json.dumps(strict_json(told), indent=1, allow_nan=False)
    write_text(folder / "design.json", text + "\n")
    if figures:
        from ctr_nlp.view.figures import save  # brings matplotlib, which takes long to load
        from ctr_nlp.view.figures.sheet import sheet

        figure = sheet(found.robot, f"Robot {title}", found.plans)
        for ending in ("svg", "pdf"):
            save(figure, folder / f"sheet.{ending}")


def _stock_entry(found: StockRounding) -> dict[str, Any]:
    return {
        "tubes": [tube._asdict() for tube in found.tubes],
        "e3_free": found.free_errors.tolist(),
        "e3": found.rounded_errors.tolist(),
        "loss": found.loss,
        "tried": found.combination_count,
    }


def _row(found: Design, evaluated: EvaluatedPlan) -> dict[str, Any]:
    """Return the entry of design.json on a plan of a design."""
    plan = evaluated.plan
    name = plan.meta["problem"]["name"]
    own = name in found.names
    return {
        "problem": name,
        "designed_for": own,
        "e3_before": found.before[found.names.index(name)] if own else None,
        "e3": summary(plan)["e3"],
        **_sample_statistics(plan.drawn),
        "diameters_as_sold": _sample_statistics(evaluated.robustness_as_sold),
        "verdicts_no": list(plan.verdicts.failed_names),
        "verdicts_not_checked": list(plan.verdicts.unchecked_names),
    }


def _sample_statistics(drawn: Robustness | None) -> dict[str, Any]:
    return {
        "mean_over_draws": None if drawn is None or drawn.errors is None else drawn.errors.mean,
        "draws": None if drawn is None else len(drawn),
        "lost": None if drawn is None else drawn.lost_count,
    }


def print_designs(designs: Sequence[DesignWithPlans], nominal: bool, walls: bool) -> None:
    """Print tables and remarks for each of `designs`, and within walls how many ends are reached.

    nominal: whether tolerances were left out.
    """
    for number, one in enumerate(designs, start=1):
        _print_design(one, f"robot {number}: " if len(designs) > 1 else "")
    if walls:
        told = [each.plan.verdicts for one in designs for each in one.evaluated_plans]
        reached = sum(one.end_reached_as_described if nominal else one.end_reached for one in told)
        console().print(f"{reached} of {len(told)} ends reached by {_name_robots(nominal)}.")


def print_left_out(files: Sequence[str], ends: Sequence[HeldOutEnd], nominal: bool) -> None:
    """Print how many ends of each file are reached by robots that were designed for the other files.

    files: names of the files, in the order in which `ends` count them. nominal: whether tolerances were left out.
    """
    rows = []
    for number, file in enumerate(files):
        reached = [end.choice.reaches for end in ends if end.anatomy == number]
        rows.append([file, len(reached), sum(reached)])
    print_table("left out of the design", ["file", "ends", "reached"], rows)
    share = sum(end.choice.reaches for end in ends) / len(ends)
    robots = _name_robots(nominal)
    console().print(f"Robots designed for all other files reach {share:.0%} of {len(ends)} ends, as {robots}.")


def _name_robots(nominal: bool) -> str:
    """Return what the robots are called for which plans were made."""
    return "robots as described" if nominal else "robots within the tolerances"


def _print_design(design: DesignWithPlans, label: str) -> None:
    found = design.design
    cells = [
        [
            row["problem"],
            *(format_cell(row[key]) for key in ("e3_before", "e3")),
            *(cell for of in (row, row["diameters_as_sold"]) for cell in _cells(of)),
            "yes" if row["designed_for"] else "held out",
        ]
        for row in (_row(found, one) for one in design.evaluated_plans)
    ]
    title = f"{label}e3 in mm, of first tubes, as planned, and its mean over samples, also of tubes as sold"
    print_table(title, list(DESIGN_TABLE_COLUMNS), cells)
    words = [
        [str(one.plan.meta["problem"]["name"]), *(each.word for each in one.plan.verdicts)]
        for one in design.evaluated_plans
    ]
    print_table(f"{label}verdicts", ["problem", *SHORT_NAMES.values()], words, styles=STYLES)
    tubes = [
        [
            *(f"{i + 1}", f"{tube.outer_diameter:.3f}", f"{tube.inner_diameter:.3f}", f"{tube.curved_length:.1f}"),
            *(f"{tube.root_curvature:.5f}", f"{tube.tip_curvature:.5f}"),
        ]
        for i, tube in enumerate(found.robot.tubes)
    ]
    columns = ["tube", "outer mm", "inner mm", "curved part mm", "curvature at root 1/mm", "at tip 1/mm"]
    print_table(f"{label}tubes", columns, tubes)
    told = () if found.stock_rounding is None else (found.stock_rounding,)
    for remark in (*told, *found.warnings, *found.remarks):
        console().print(f"{remark}.")


def _cells(of: dict[str, Any]) -> tuple[str, str]:
    """Return the mean error over simulated robots, and how many of them failed, as text."""
    return format_cell(of["mean_over_draws"]), "" if of["draws"] is None else f"{of['lost']} of {of['draws']}"
