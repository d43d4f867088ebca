"""`ctr-nlp under`: a plan's motion of a robot that bears a load."""

from __future__ import annotations

import argparse
from pathlib import Path

from ctr_nlp.cli.arguments import add_figures_option, add_out_option
from ctr_nlp.cli.console import Command, console
from ctr_nlp.cli.loads.options import add_load_options, add_modulus_option, read_load, read_plan
from ctr_nlp.cli.output.file import path_component
from ctr_nlp.cli.output.folder import check_folder, published
from ctr_nlp.cli.report import draw, exit_status, print_report, write


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Move the robot of a plan through its motion while it bears a load: shapes, errors, stability "
        "margins and snaps on the elastic model. The load comes in the first frame and is taken away in the last "
        "one. Write the plan under its load, errors.csv, summary.json and pictures; `ctr-nlp robust` and "
        "`ctr-nlp report` take that plan as any other.",
        epilog="Exit status: 0 no verdict is no, 1 one is, 2 bad input, nothing written.",
    )
    parser.add_argument("plan", metavar="PLAN.npz")
    add_load_options(parser)
    add_modulus_option(parser)
    add_out_option(parser, "runs/PROBLEM-under")
    add_figures_option(parser)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    plan, load = read_plan(arguments), read_load(arguments)
    out = Path(arguments.out or f"runs/{path_component(str(plan.meta['problem']['name']))}-under")
    check_folder(out, "under")
    found = plan.under(load)
    print_report(found)
    with published(out, "under") as staging:
        write(found, staging)
        if not arguments.no_figures:
            draw(found, (), staging)
        files = sorted(path.name for path in staging.iterdir())
    console().print(f"wrote {out}: {', '.join(files)}")
    return exit_status(found)


main = Command("ctr-nlp under", _parser, _run)
