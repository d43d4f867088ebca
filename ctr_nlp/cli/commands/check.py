"""`ctr-nlp check`: check a plan a second time, with code that shares nothing with the planners."""

from __future__ import annotations

import argparse

from ctr_nlp.check.comparison import Opinion
from ctr_nlp.cli.arguments import count
from ctr_nlp.cli.console import EXIT_SOLVED, EXIT_SOME_FAILED, Command
from ctr_nlp.cli.plan_report import STYLES
from ctr_nlp.cli.second_opinion import form_opinions
from ctr_nlp.cli.terminal_output import busy, console, print_table
from ctr_nlp.plan.summary_text import NOT_FOR_PATIENTS

COLUMNS = "matter", "plan", "number", "checker", "number ", "agree", "why"


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Check a plan a second time, from plan.npz and the equations alone: another formulation of "
        "the tubes, another integrator and another search for the wall. Each verdict is shown beside the plan's "
        "own, and what the file records is compared with what was found. What is not covered says so.",
        epilog="Exit status: 0 where the checker agrees with the plan, 1 where it disagrees in a verdict or finds "
        "that the file's record does not fit its motion, 2 where input is bad.",
    )
    parser.add_argument("plan", metavar="PLAN.npz")
    what = "simulated robots that are moved, too: the first ones in the file, or new ones (default none)"
    parser.add_argument("--samples", metavar="N", type=count, default=0, help=what)
    what = "centreline that the plan was made for (.csv with x_mm, y_mm, z_mm, or .mrk.json); checks its axes"
    parser.add_argument("--centreline", metavar="FILE", help=what)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    with busy(f"{arguments.plan} is checked"):
        opinions = form_opinions(arguments.plan, arguments.samples, arguments.centreline)
    print_table(
        f"{arguments.plan}: the plan's verdicts beside the checker's",
        COLUMNS,
        _rows(opinions, arguments.samples),
        text=("why",),
        styles=STYLES,
    )
    apart = [each.name.replace("_", " ") for each in opinions if not each.agrees]
    missing = [each.name.replace("_", " ") for each in opinions if each.word not in STYLES]
    if missing:
        console().print(f"Not covered by the checker: {', '.join(missing)}.")
    told = f"The checker disagrees: {', '.join(apart)}." if apart else "The checker agrees in what it covers."
    console().print(told)
    console().print(NOT_FOR_PATIENTS)
    return EXIT_SOME_FAILED if apart else EXIT_SOLVED


def _rows(opinions: list[Opinion], samples: int) -> list[tuple[object, ...]]:
    """Return rows of the table: an empty cell where there is nothing to compare.

    samples: how many robots the checker was to simulate.
    """
    asked = () if samples else ("holds", "samples")
    return [
        (
            *(each.name.replace("_", " "), each.own_word or "", each.own_number),
            *(each.word, each.number, "" if not _is_compared(each) else "yes" if each.agrees else "no"),
            f"{each.why} --samples N simulates N." if each.name in asked and each.word not in STYLES else each.why,
        )
        for each in opinions
    ]


def _is_compared(opinion: Opinion) -> bool:
    """Return whether both sides say something, or the checker compared the record."""
    return not opinion.agrees or (opinion.word in STYLES and opinion.own_word in (None, "yes", "no"))


main = Command("ctr-nlp check", _parser, _run)
