"""A plan as files, as pictures and a film, and as a table on the terminal.

What draws is imported where it draws: matplotlib takes longer to load than a motion takes to be planned.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from ctr_nlp.cli.console import INTERRUPTED, SOLVED, SOME_FAILED
from ctr_nlp.cli.output.folder import name_within
from ctr_nlp.cli.telling import console, print_table, progress_bar
from ctr_nlp.plan import account, drawn_account
from ctr_nlp.plan.metrics import by_frame, summary
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.verdicts import SURVIVES
from ctr_nlp.studies.trade_off import Point
from ctr_nlp.support.tables import by_line, write_csv


def write(plan: Plan, folder: Path) -> None:
    """plan.npz, errors.csv and summary.json."""
    plan.save(folder / "plan.npz")
    write_csv(folder / "errors.csv", by_line(by_frame(plan)))
    text = json.dumps(summary(plan), indent=2, allow_nan=False)
    (folder / "summary.json").write_text(text + "\n", encoding="utf-8")


def draw(plan: Plan, points: Sequence[Point], folder: Path) -> None:
    """The pictures of a plan, and where a sweep has found points, theirs."""
    from ctr_nlp.figures import save_all

    save_all(plan, folder)
    if points:
        from ctr_nlp.studies.front import save_front

        save_front(points, plan.meta["problem"]["name"], folder)


def print_report(plan: Plan) -> None:
    """The verdicts on a plan, its numbers, and what is wrong with it."""
    found = summary(plan)
    print_table(account.title(found), account.VERDICTS, account.verdict_rows(found), text=("why",))
    print_table("numbers", ("", "value", "unit"), account.rows(found))
    for remark in account.remarks(plan, found):
        console().print(remark)


def print_robustness(plan: Plan) -> None:
    """What becomes of a plan on its draws: errors, losses and what each tolerance costs."""
    assert plan.drawn is not None
    for table in drawn_account.tables(plan.drawn):
        print_table(table.title, table.columns, table.rows)
    console().print(plan.verdicts.survives_draws.why)
    for sentence in drawn_account.sentences(plan.drawn):
        console().print(sentence)


def exit_status(plan: Plan, tried: bool = False) -> int:
    """0 where no verdict is no, 1 where one is, 130 interrupted; tried: whether that on draws counts."""
    if plan.meta.get("interrupted", False):
        return INTERRUPTED
    return SOME_FAILED if any(tried or matter != SURVIVES for matter in plan.verdicts.failed) else SOLVED


def write_front(points: Sequence[Point], folder: Path) -> None:
    """pareto.csv."""
    write_csv(folder / "pareto.csv", [asdict(point) for point in points])


def print_front(points: Sequence[Point]) -> None:
    """A line a weight, then a line a method."""
    rows = [
        (p.method + " *" * (not p.solved), f"{p.motion_weight:.2g}", p.e3, f"{p.roughness:.0f}") for p in points
    ]
    title = "error against roughness (a star: not solved everywhere)"
    print_table(title, ("", "weight s²", "e3 mm", "roughness mm²/s"), rows)


def write_film(plans: Sequence[Plan], file: Path, out: Path, place: Path, staging: Path) -> Path:
    """Write a film of plans and show how far it is; returns where it will be. Raises OptionError, OutputError.

    out: the output folder that was asked for; place: the one that takes staging's files, another where the run was
    interrupted, which then takes all films. Otherwise a file that is not within out is written where it is to be.
    """
    from ctr_nlp.figures.film import film

    inner = name_within(out, file)
    if inner is None and place == out:
        target = found = file
    else:
        target, found = staging / (inner or file.name), place / (inner or file.name)
    with progress_bar() as labelled:
        film(plans, target, labelled(file.name))
    return found
