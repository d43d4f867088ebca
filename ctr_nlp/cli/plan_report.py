"""Write and print plans: files, pictures, a film, and tables on the terminal.

Drawing is imported where it is needed: matplotlib takes longer to load than a motion takes to plan.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctr_nlp.cli.console import EXIT_INTERRUPTED, EXIT_SOLVED, EXIT_SOME_FAILED
from ctr_nlp.cli.output.folder import name_within
from ctr_nlp.cli.terminal_output import console, print_table, progress_bar
from ctr_nlp.plan import sample_text, summary_text
from ctr_nlp.plan.metrics import by_frame, summary
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.verdicts import NO, NOT_CHECKED, YES
from ctr_nlp.support.tables import columns_to_rows, write_csv

if TYPE_CHECKING:
    from ctr_nlp.planning.compromise import Compromise
    from ctr_nlp.studies.pareto_front import ParetoPoint

STYLES = {YES: "green", NO: "bold red", NOT_CHECKED: "dark_orange"}
"""Colours of a verdict's word in a terminal; amber is not the colour of *yes*."""


def write(plan: Plan, folder: Path) -> None:
    """Write plan.npz, errors.csv and summary.json of a plan into `folder`."""
    plan.save(folder / "plan.npz")
    write_csv(folder / "errors.csv", columns_to_rows(by_frame(plan)))
    text = json.dumps(summary(plan), indent=2, allow_nan=False)
    (folder / "summary.json").write_text(text + "\n", encoding="utf-8")


def draw(plan: Plan, points: Sequence[ParetoPoint], folder: Path, found: Sequence[Compromise] = ()) -> None:
    """Draw a plan into files of a folder, with a progress bar.

    plan: the plan. points: of a sweep of motion weights, drawn where there are any. folder: an existing folder.
    found: compromises between arrival and contact, drawn where there are any.
    """
    from ctr_nlp.view.figures import save, save_all

    with progress_bar() as labelled:
        save_all(plan, folder, progress=labelled("pictures are drawn"))
        if found:
            from ctr_nlp.view.figures.compromise import compromise

            labelled("arrival against contact is drawn")
            save(compromise(plan, found), folder / "trade_off.png")
        if points:
            from ctr_nlp.studies.pareto_picture import save_pareto_front

            labelled("error against roughness is drawn")
            save_pareto_front(points, plan.meta["problem"]["name"], folder)


def draw_shapes_only(plan: Plan, folder: Path) -> None:
    """Draw the shapes of a plan alone, which is fastest, into `folder`."""
    from ctr_nlp.view.figures import save
    from ctr_nlp.view.figures.overlay import shapes

    save(shapes(plan), folder / "shapes.png")


def draw_film(plan: Plan, file: Path) -> None:
    """Draw a plan as a film into `file`, without a progress bar: one on the next step may be running."""
    from ctr_nlp.view.figures.film import film

    film([plan], file)


def print_report(plan: Plan) -> None:
    """Print the verdicts on a plan, its numbers, and remarks on what is wrong with it."""
    found = summary(plan)
    print_verdicts(found)
    print_table("numbers", ("", "value", "unit"), summary_text.measure_rows(found))
    for remark in summary_text.remarks(plan, found):
        console().print(remark)


def print_verdicts(found: dict[str, Any]) -> None:
    """Print the table of verdicts of a plan's summary `found`, its words in colour, and a conclusion."""
    rows = summary_text.verdict_rows(found)
    print_table(summary_text.title(found), summary_text.VERDICTS, rows, text=("value", "why"), styles=STYLES)
    console().print(summary_text.summarise_verdicts(found))
    console().print(summary_text.NOT_FOR_PATIENTS)


def print_robustness(plan: Plan) -> None:
    """Print the verdicts on a plan, and statistics of its simulated robots: arrival, contact, errors, losses,
    costs.
    """
    assert plan.drawn is not None
    print_verdicts(summary(plan))
    for table in sample_text.tables(plan):
        print_table(table.title, table.columns, table.rows)
    for sentence in (plan.drawn.summary_sentence, *sample_text.robustness_sentences(plan.drawn)):
        console().print(sentence)


def exit_status(plan: Plan) -> int:
    """Return 0 where no verdict is *no*, 1 where one is, 130 where the plan was interrupted."""
    if plan.meta.get("interrupted", False):
        return EXIT_INTERRUPTED
    return EXIT_SOME_FAILED if plan.verdicts.failed_names else EXIT_SOLVED


def write_front(points: Sequence[ParetoPoint], folder: Path) -> None:
    """Write pareto.csv with a row for each of `points` into `folder`."""
    write_csv(folder / "pareto.csv", [asdict(point) for point in points])


def print_front(points: Sequence[ParetoPoint]) -> None:
    """Print a row for each of `points`: weights first, then other methods."""
    rows = [
        (p.method + " *" * (not p.solved), f"{p.motion_weight:.2g}", p.e3, f"{p.roughness:.0f}") for p in points
    ]
    title = "error against roughness (a star: not solved everywhere)"
    print_table(title, ("", "weight s²", "e3 mm", "roughness mm²/s"), rows)


def write_compromises(plan: Plan, found: Sequence[Compromise], folder: Path) -> None:
    """Write trade_off.csv, arrival against contact, with a row for each of `found` of a plan into `folder`."""
    write_csv(folder / "trade_off.csv", [_row(plan, one) for one in found])


def _row(plan: Plan, one: Compromise) -> dict[str, Any]:
    """Return a motion of the trade-off of a plan as a row of trade_off.csv."""
    # Most plans need no compromise.
    from ctr_nlp.planning.compromise import find_arrival_weight, planned_for

    touched = one.where
    return {
        "motion": "this plan" if one.arrival_weight is None else "another",
        "arrival_weight": find_arrival_weight(plan, one),
        "planned_for": planned_for(plan, one),
        "tip_mm": one.tip,
        "contact_mm": one.contact,
        "e3_mm": one.e3,
        "tube": None if touched is None else touched.tube,
        "along_robot_mm": None if touched is None else touched.arc_length,
        "frame": None if touched is None else touched.frame,
    }


def print_compromises(plan: Plan, found: Sequence[Compromise]) -> None:
    """Print the compromises `found` between arriving and keeping off the wall, and what limits `plan`."""
    # Most plans need no compromise.
    from ctr_nlp.planning.compromise import compromise_sentences, find_arrival_weight, planned_for

    columns = "--arrival-weight", "tip off mm", "deepest contact mm", "e3 mm", "at", "planned for"
    rows = [
        (
            f"{find_arrival_weight(plan, one):g}{', this plan' if one.arrival_weight is None else ''}",
            *(one.tip, one.contact, one.e3),
            "" if one.where is None else f"tube {one.where.tube}, {one.where.arc_length:.0f} mm",
            planned_for(plan, one),
        )
        for one in found
    ]
    title = "arrival against contact: what the robot as described does on each motion"
    print_table(title, columns, rows, text=("at", "planned for"))
    for sentence in compromise_sentences(plan, found):
        console().print(sentence)


def write_film(plans: Sequence[Plan], file: Path, out: Path, place: Path, staging: Path) -> Path:
    """Write a film of plans with a progress bar; return where it will be. Raises OptionError, OutputError.

    plans: side by side. file: asked for by the user. out: output folder that was asked for. place: folder that
    takes staging's files, within `out` where the run was interrupted; it then takes all films. staging: files
    before publication. Otherwise a file outside of `out` is written where it is to be.
    """
    from ctr_nlp.view.figures.film import film

    inner = name_within(out, file)
    if inner is None and place == out:
        target = found = file
    else:
        target = staging / (inner or file.name)
        found = place / (inner or file.name)
    with progress_bar() as labelled:
        film(plans, target, labelled(file.name))
    return found
