"""`ctr-nlp under`: simulate a plan's motion of a loaded robot."""

from __future__ import annotations

import argparse
from pathlib import Path

from ctr_nlp.cli.arguments import add_figures_option, add_out_option
from ctr_nlp.cli.console import Command
from ctr_nlp.cli.loads.options import add_load_options, add_modulus_option, load_from, read_plan
from ctr_nlp.cli.output.file import path_component
from ctr_nlp.cli.output.folder import check_folder, output_folder
from ctr_nlp.cli.plan_options import add_check_options, add_threshold_options, evaluate_plan, with_thresholds
from ctr_nlp.cli.plan_report import draw, exit_status, print_report, write
from ctr_nlp.cli.terminal_output import busy, report_written_files
from ctr_nlp.exceptions import OptionError
from ctr_nlp.plan.plan import Plan

SAME_TARGET_TOLERANCE_MM = 1e-3
"""Distance up to which two targets count as the same."""


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Simulate the motion of a plan under a load, on the elastic model: shapes, errors, stability "
        "margins and snaps. The load is applied in the first frame and removed in the last one. Write the plan "
        "under its load, errors.csv, summary.json and pictures; `ctr-nlp robust` and `ctr-nlp report` take that "
        "plan like any other.",
        epilog="Exit status: 0 where no verdict is `no`, 1 where one is, 2 where input is bad and nothing is "
        "written.",
    )
    parser.add_argument("plan", metavar="PLAN.npz")
    add_load_options(parser)
    add_modulus_option(parser)
    parser.add_argument(
        "--beside",
        metavar="PLANNED.npz",
        help="a plan of the same target that was made for the load, to be shown beside in beside.png",
    )
    add_check_options(parser)
    add_threshold_options(parser)
    add_out_option(parser, "runs/PROBLEM-under")
    add_figures_option(parser)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    plan = read_plan(arguments)
    load = load_from(arguments)
    out = Path(arguments.out or f"runs/{path_component(str(plan.meta['problem']['name']))}-under")
    planned = _load_comparison_plan(plan, arguments.beside)
    check_folder(out, "under")
    with busy(f"{plan.meta['problem']['name']}: the robot is moved under the load"):
        found = evaluate_plan(with_thresholds(plan, arguments).with_load(load), arguments)
    with output_folder(out, "under") as staging:
        write(found, staging)
        if not arguments.no_figures:
            draw(found, (), staging)
            _draw_beside(
                {"without the load": plan.evaluate_on("elastic"), "under the load": found} | planned, staging
            )
        files = sorted(path.name for path in staging.iterdir())
    print_report(found)
    report_written_files(out, files)
    return exit_status(found)


def _draw_beside(plans: dict[str, Plan], folder: Path) -> None:
    from ctr_nlp.view.figures import save
    from ctr_nlp.view.figures.shape_comparison import shapes_compared

    found = plans["under the load"]
    save(shapes_compared(plans, f"{found.meta['problem']['name']}: {found.evaluated_load}"), folder / "beside.png")


def _load_comparison_plan(plan: Plan, name: str | None) -> dict[str, Plan]:
    """Load the plan `name` to be shown beside; raises OptionError where it has another target."""
    if name is None:
        return {}
    planned = Plan.load(name)
    if (
        planned.target.shape != plan.target.shape
        or abs(planned.target - plan.target).max() > SAME_TARGET_TOLERANCE_MM
    ):
        raise OptionError(f"--beside {name} follows another target than the plan; give one of the same problem")
    return {"planned for the load": planned}


main = Command("ctr-nlp under", _parser, _run)
