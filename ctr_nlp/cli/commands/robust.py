"""`ctr-nlp robust`: simulate a plan on robots within the tolerances."""

from __future__ import annotations

import argparse
from pathlib import Path

from ctr_nlp.cli.arguments import add_figures_option, add_out_option, whole
from ctr_nlp.cli.console import Command
from ctr_nlp.cli.output.file import path_component
from ctr_nlp.cli.output.folder import check_folder, output_folder
from ctr_nlp.cli.plan_options import add_evaluate_option, add_threshold_options, with_thresholds
from ctr_nlp.cli.plan_report import exit_status, print_robustness, write
from ctr_nlp.cli.terminal_output import busy, report_written_files
from ctr_nlp.exceptions import OptionError
from ctr_nlp.plan.monte_carlo import DEFAULT_PLAN_SAMPLE_SEED, DEFAULT_PLAN_SAMPLES
from ctr_nlp.plan.plan import Plan
from ctr_nlp.support.value_checks import whole_number


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Simulate a plan, open loop, on robots sampled within the tolerances of the robot file. "
        "Report how many fail and where, how large errors are, and which tolerance costs most. Write the plan "
        "with these results, errors.csv, summary.json and a picture.",
        epilog="Exit status: 0 where no verdict is `no`, 1 where one is, 2 where input is bad and nothing is "
        "written. A plan holds on built robots where enough of them (--share) keep their branch of equilibria, "
        "arrive, and press into the wall by no more than 1 mm.",
    )
    parser.add_argument("plan", metavar="PLAN.npz")
    what = f"number of simulated robots (default {DEFAULT_PLAN_SAMPLES})"
    parser.add_argument("--draws", metavar="N", type=whole, default=DEFAULT_PLAN_SAMPLES, help=what)
    parser.add_argument(
        "--seed",
        metavar="N",
        type=whole,
        default=DEFAULT_PLAN_SAMPLE_SEED,
        help=f"random seed of the simulated robots (default {DEFAULT_PLAN_SAMPLE_SEED})",
    )
    add_evaluate_option(parser, "the elastic one")
    add_threshold_options(parser)
    add_out_option(parser, "runs/PROBLEM-robust")
    add_figures_option(parser)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    plan = Plan.load(arguments.plan)
    whole_number(OptionError, "draws", arguments.draws)
    out = Path(arguments.out or f"runs/{path_component(str(plan.meta['problem']['name']))}-robust")
    check_folder(out, "robust")
    plan = with_thresholds(plan if arguments.evaluate is None else plan.evaluate_on(arguments.evaluate), arguments)
    with busy(f"{plan.meta['problem']['name']}: {arguments.draws} robots are moved"):
        look = plan.check if arguments.evaluate is None else plan.with_samples
        plan = look(arguments.draws, arguments.seed)
    if plan.drawn is None:
        why = "was interrupted" if plan.meta.get("interrupted", False) else "has no frame that was reached"
        raise OptionError(
            f"plan {arguments.plan} {why}, so there is nothing to simulate; run `ctr-nlp plan` again"
        )
    with output_folder(out, "robust") as staging:
        write(plan, staging)
        if not arguments.no_figures:
            from ctr_nlp.view.figures import save  # brings matplotlib, which takes long to load
            from ctr_nlp.view.figures.robustness_plot import robustness

            save(robustness(plan), staging / "robustness.png")
        files = sorted(path.name for path in staging.iterdir())
    print_robustness(plan)
    report_written_files(out, files)
    return exit_status(plan)


main = Command("ctr-nlp robust", _parser, _run)
