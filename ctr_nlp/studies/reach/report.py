"""Files about the reach of robots in a tree: a table, a map, a page and a summary."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from ctr_nlp.anatomy.branch import format_point, transform_points
from ctr_nlp.anatomy.lumen_tree import WIDTH_MARGIN_MM
from ctr_nlp.exceptions import escape_control_characters
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.plan.summary_text import NOT_FOR_PATIENTS, format_cell
from ctr_nlp.studies.reach.outcomes import (
    MISSED,
    NARROW,
    NEARLY,
    NEARLY_MM,
    UNENTERED,
    UNPLANNED,
    EndOutcome,
)
from ctr_nlp.studies.reach.reach import Reach
from ctr_nlp.studies.reached.cases import REACHED
from ctr_nlp.studies.reached.report import FAILS
from ctr_nlp.support.tables import write_csv
from ctr_nlp.support.value_checks import strict_json
from ctr_nlp.view.figures import save
from ctr_nlp.view.figures.branches import BranchGroup, tree
from ctr_nlp.view.figures.parts.palette import GREEN, ORANGE, SKY, VERMILLION

OUTCOME_COLOURS: Mapping[str, str] = {
    REACHED: GREEN,
    NEARLY: ORANGE,
    UNPLANNED: SKY,
    MISSED: VERMILLION,
    NARROW: "#A6A6A6",
    UNENTERED: "#D9D9D9",
}
"""Colour of each outcome, the best first."""
CSV_NAME, MAP_NAME, PAGE_NAME, SUMMARY_NAME = "reach.csv", "tree.png", "reach.html", "summary.json"
TABLE_COLUMNS = ("end", "depth", "room", "robot", "outcome", "tip", "contact", "hold", "binds")
"""Columns of the table of ends; depth, room, tip and contact in mm."""
ROBOT_LETTERS, BINDS_LETTERS = 12, 16
"""Letters of a robot's name and of what binds that the table shows, so that it is at most 100 columns wide."""
PAGE_STYLE = """body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 72rem }
img { max-width: 100% } table { border-collapse: collapse; margin: 1rem 0 } caption { text-align: left }
th, td { padding: .15rem .6rem; text-align: right; border-bottom: 1px solid #ddd }
td.text, th.text { text-align: left } .mark { border-left: .6rem solid }"""


def legends() -> dict[str, str]:
    """Return what each outcome means, in the words of the map's key."""
    allowed = Settings()
    return {
        REACHED: "reached: all checks are yes",
        NEARLY: (
            f"nearly: tip {allowed.arrival_tolerance + NEARLY_MM:g} mm off\nand contact "
            f"{allowed.contact_allowed + NEARLY_MM:g} mm at most"
        ),
        MISSED: "not reached",
        UNPLANNED: "not planned yet",
        NARROW: f"too narrow: less than {WIDTH_MARGIN_MM:g} mm\naround the robot",
        UNENTERED: "not beyond the entry",
    }


def write(found: Reach, folder: Path) -> None:
    """Write reach.csv, summary.json, tree.png and reach.html into an existing folder.

    Parameters
    ----------
    found : Reach
        The outcomes.
    folder : Path
        The folder.
    """
    write_csv(folder / CSV_NAME, [asdict(one) for one in found.outcomes])
    text = json.dumps(strict_json(summary_of(found)), indent=2)
    (folder / SUMMARY_NAME).write_text(f"{text}\n", encoding="utf-8")
    _draw_map(found, folder / MAP_NAME)
    picture = base64.b64encode((folder / MAP_NAME).read_bytes()).decode()
    (folder / PAGE_NAME).write_text(_page(found, picture), encoding="utf-8")


def summary_of(found: Reach) -> dict[str, object]:
    """Return the summary: what was asked for, and how many ends have which outcome for which robot."""
    return {
        "file": found.tree.name,
        "entry": found.tree.entry.tolist(),
        "space": found.tree.branches.space,
        "ends": len(found.tree.ends),
        "robust": found.robust,
        "complete": found.complete,
        "robots": found.counts(),
        "process_s": sum(one.process_s for one in found.outcomes if one.process_s == one.process_s),
    }


def totals(found: Reach) -> list[str]:
    """Return a sentence on how many ends each robot reaches, and one on all robots together.

    Ends that are not planned yet are named before the first semicolon, where titles are cut.

    Parameters
    ----------
    found : Reach
        The outcomes.

    Returns
    -------
    list of str
        One sentence for each robot and, where there are several, one for all.
    """
    several = len(found.robots) > 1
    return [
        f"{'at least one robot' if name == 'any' else name}: {count[REACHED]} of {count['wide_enough']} "
        f"wide-enough ends reached{_say_unplanned(found, name)}; {count['as_described']} as described, "
        f"{count[NEARLY]} nearly, {count[NARROW]} too narrow"
        for name, count in found.counts().items()
        if name != "any" or several
    ]


def _say_unplanned(found: Reach, name: str) -> str:
    """Return how many ends wait for a plan for the robot `name`, or for any robot; empty where none does."""
    waiting = {one.end for one in found.outcomes if one.outcome == UNPLANNED and name in (one.robot, "any")}
    if name == "any":
        waiting -= {one.end for one in found.best if one.outcome == REACHED}
    verb = "is" if len(waiting) == 1 else "are"
    return f" so far, {len(waiting)} {verb} not planned yet" if waiting else ""


def table_row(one: EndOutcome, whole: bool = False) -> list[str]:
    """Return the cells of an end's row, as TABLE_COLUMNS; whole: without cutting long texts."""
    held = "" if one.held != one.held else f"{100 * one.held:.0f} %"
    numbers = [format_mm(value) for value in (one.tip, one.contact)]
    binds = one.binds
    if one.bound == one.bound and one.bound > 0:
        binds = f"{binds}; at least {one.bound:.1f} mm off"
    robot = one.robot
    if not whole:
        binds, robot = _shorten(binds, BINDS_LETTERS), _shorten(robot, ROBOT_LETTERS)
    return [
        str(one.end),
        format_mm(one.depth, 0),
        format_mm(one.margin),
        robot,
        say_outcome(one),
        *numbers,
        held,
        binds,
    ]


def say_outcome(one: EndOutcome) -> str:
    """Return an outcome in words, with the first check that fails."""
    if one.outcome not in (NEARLY, MISSED):
        return one.outcome
    why = FAILS.get(one.failed, "path too long")
    why = "not when built" if one.failed == "holds" else why
    return f"nearly: {why}" if one.outcome == NEARLY else why


def format_mm(value: float, digits: int = 2) -> str:
    """Return a number of mm as text, empty where it is not known."""
    return "" if value != value else f"{value:.{digits}f}"


def _shorten(text: str, letters: int) -> str:
    return text if len(text) <= letters else f"{text[: letters - 1]}\N{HORIZONTAL ELLIPSIS}"


def _draw_map(found: Reach, path: Path) -> None:
    """Draw the tree in the colours of its ends' best outcomes."""
    told = legends()
    groups = [
        BranchGroup(told[kind], colour, members)
        for kind, colour in OUTCOME_COLOURS.items()
        if (members := [k for k, one in enumerate(found.best) if one.outcome == kind])
    ]
    branches = found.tree.branches
    paths = [transform_points(branch.points, branches.from_lps) for branch in branches.branches]
    title = f"{escape_control_characters(found.tree.name)}\n{totals(found)[-1].partition(';')[0]}"
    save(tree(paths, [end.name for end in found.tree.ends], title, branches.space, groups), path)


def _page(found: Reach, picture: str) -> str:
    """Return the page: totals, map, a table of what fails first, and a row for each end and robot."""
    how = "for all robots within the tolerances" if found.robust else "for the robots as described"
    entry = f"{format_point(found.tree.entry.round(1))} mm, {found.tree.branches.space}"
    listed = "".join(f"<li>{html.escape(line)}.</li>" for line in totals(found))
    meaning = "".join(
        f'<tr><td class="text mark" style="border-color: {colour}">{html.escape(legends()[kind])}</td></tr>'
        for kind, colour in OUTCOME_COLOURS.items()
    )
    rows = "".join(_html_row(one) for one in found.outcomes)
    heads = "".join(
        f"<th{' class=text' if name in ('robot', 'outcome', 'binds') else ''}>{name}</th>"
        for name in (*TABLE_COLUMNS, "where, or why")
    )
    name = html.escape(found.tree.name)
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>Reach in {name}</title><style>{PAGE_STYLE}</style></head><body>
<h1>Reach in {name}</h1>
<p>Plans {how}, entered at {entry}. {html.escape(NOT_FOR_PATIENTS)}</p>
<ul>{listed}</ul>
<p><img alt="Map of the tree" src="data:image/png;base64,{picture}"></p>
<table>{meaning}</table>
{_failure_table(found)}
<table><caption>Ends. Depth, room (radius of the lumen less that of the robot), tip and contact in mm; hold: share
of the simulated robots within the tolerances. Places are in the file's coordinates.</caption>
<tr>{heads}</tr>{rows}</table>
</body></html>
"""


def _html_row(one: EndOutcome) -> str:
    """Return the row of an end and a robot."""
    where = one.reason
    if not where and one.contact > 0:
        place = (one.contact_x, one.contact_y, one.contact_z)
        where = f"deepest {one.contact_along:.0f} mm along the robot, at ({', '.join(f'{x:.1f}' for x in place)})"
    cells = table_row(one, whole=True)
    kinds = [" class=text" if name in ("robot", "outcome", "binds") else "" for name in TABLE_COLUMNS]
    kinds[0] = f' class="mark" style="border-color: {OUTCOME_COLOURS[one.outcome]}"'
    body = "".join(f"<td{kind}>{html.escape(cell)}</td>" for kind, cell in zip(kinds, cells, strict=True))
    return f'<tr>{body}<td class="text">{html.escape(where)}</td></tr>'


def count_binding(found: Reach) -> dict[str, int]:
    """Count how often each constraint is active at the ends that were planned and not reached.

    Parameters
    ----------
    found : Reach
        The outcomes.

    Returns
    -------
    dict
        By constraint, the most frequent first; several may be active at one end.
    """
    counts = dict[str, int]()
    for one in found.outcomes:
        for name in filter(None, one.binds.split(", ")):
            counts[name] = counts.get(name, 0) + 1
    return dict(sorted(counts.items(), key=lambda item: -item[1]))


def _failure_table(found: Reach) -> str:
    """Return the tables of the first check that fails and of the constraints that are active."""
    failed = dict[str, int]()
    for one in found.outcomes:
        if one.wide_enough and one.failed:
            failed[FAILS.get(one.failed, "path too long")] = (
                failed.get(FAILS.get(one.failed, "path too long"), 0) + 1
            )
    return _count_table("First check that fails, of all plans", failed) + _count_table(
        "What binds where the motion ends, of plans that fail; several may", count_binding(found)
    )


def _count_table(title: str, counts: Mapping[str, int]) -> str:
    rows: Sequence[str] = [
        f'<tr><td class="text">{html.escape(name)}</td><td>{format_cell(number)}</td></tr>'
        for name, number in counts.items()
    ]
    return f"<table><caption>{html.escape(title)}</caption>{''.join(rows)}</table>" if rows else ""
