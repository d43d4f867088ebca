"""The report: one HTML file with scenes, plots, numbers, and the script that keeps them in step."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from importlib import resources
from typing import Any

import numpy as np

from ctr_nlp.check.comparison import Opinion
from ctr_nlp.exceptions import OptionError, escape_control_characters
from ctr_nlp.plan import sample_text, summary_text
from ctr_nlp.plan.metrics import by_frame, summary
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.verdicts import NO, NOT_CHECKED, YES, Verdict
from ctr_nlp.support.extras import import_extra
from ctr_nlp.typing import Array
from ctr_nlp.view.figures.parts.orientation import picture_axes
from ctr_nlp.view.figures.parts.page import AT_FRAME, BETWEEN_FRAMES
from ctr_nlp.view.figures.parts.palette import tube_colour
from ctr_nlp.view.figures.parts.wall_forces import WALL_FORCE_COLOUR, describe_force_lines
from ctr_nlp.view.report.camera import EYE_FIELD_OF_VIEW_DEG, OUTSIDE_FIELD_OF_VIEW_DEG, cameras, eyes
from ctr_nlp.view.report.ghosts import (
    MAX_REPORT_GHOSTS,
    REPORT_FAILED_GHOST_COLOUR,
    REPORT_GHOST_COLOUR,
    SAMPLED_ROBOTS_PART,
)
from ctr_nlp.view.report.places import arrival_tolerance, coordinates, printed_frames, way_to_go
from ctr_nlp.view.report.plots import EXTENT, Plot, plots
from ctr_nlp.view.report.scene import (
    SCENE_DATA_PLACEHOLDER,
    SCENE_FORCES_PART,
    SCENE_ROBOT_PART,
    SCENE_TARGET_END_COLOUR,
    SCENE_TARGET_END_PART,
    SCENE_TARGET_PART,
    SCENE_WALL_PART,
    TUBE_COLOURING,
    ColourScale,
    box,
    quantities,
    scales,
    scene,
    scene_template,
)

READOUT = {
    "e2": ("error e2", "mm"),
    "max": ("largest error", "mm"),
    "clearance": (f"clearance {AT_FRAME}", "mm"),
    "clearance_between": (BETWEEN_FRAMES, "mm"),
    "stability": (f"stability margin {AT_FRAME}", ""),
    "stability_between": (BETWEEN_FRAMES, ""),
}
"""Columns of errors.csv that are shown for the frame on display, with their names, which may go on from the one
before, and units."""
PAGE_SCRIPT_FILES = ("scenes.js", "camera.js", "player.js", "page.js")
"""Parts of the page's script, each after those that it needs."""
VERDICT_SIGNS = {YES: "\N{CHECK MARK}", NO: "\N{BALLOT X}", NOT_CHECKED: "?"}
"""Signs beside the word of a verdict: not everyone can tell the colours."""
ENDOSCOPE_WALL_COLOUR, ENDOSCOPE_DARK_DISTANCE_MM = 0xE79A8C, 60.0
"""Colour of the wall as the tip sees it, and the distance from the tip at which its light no longer reaches."""
ENDOSCOPE_LIGHT_INTENSITY, ENDOSCOPE_GLOW_INTENSITY = 2.5, 2.0
"""Intensities of the tip's light on walls ahead, and on all walls; with pi, a wall has its own colour."""
PAGE_PLAYBACK_SPEEDS = ("0.25", "0.5", "1", "2", "4")
"""Playback speeds, as multiples of the plan's own."""


def page(
    plans: Sequence[Plan],
    names: Sequence[str] | None = None,
    opinions: Sequence[Sequence[Opinion]] | None = None,
) -> str:
    """Return a page for one plan, or for several side by side in step, as HTML that needs no other file and no
    network.

    plans: at least one. names: what to call each plan besides its title, such as its file. opinions: of the
    independent checker on each plan, where it was checked. Raises OptionError without plans, or where the extra
    `report` is not installed.
    """
    if not plans:
        raise OptionError("plans is empty; give at least one")
    coloured, (low, high), plotted = scales(plans), box(plans), plots(plans)
    axes = picture_axes(plans)
    told = [
        _plan_texts(plan, name) | {"plots": some.items(), "checked": _checker_rows(each)}
        for plan, name, some, each in zip(
            plans, names or [""] * len(plans), plotted, opinions or [()] * len(plans), strict=True
        )
    ]
    data = {
        "template": scene_template(),
        "placeholder": SCENE_DATA_PLACEHOLDER,
        "cameras": cameras(low, high, axes),
        "fields": {"outside": OUTSIDE_FIELD_OF_VIEW_DEG, "eye": EYE_FIELD_OF_VIEW_DEG},
        "endoscope": {
            "wall": ENDOSCOPE_WALL_COLOUR,
            "dark": ENDOSCOPE_DARK_DISTANCE_MM,
            "light": ENDOSCOPE_LIGHT_INTENSITY,
            "glow": ENDOSCOPE_GLOW_INTENSITY,
            "part": SCENE_WALL_PART,
        },
        "plans": [
            _animation_data(
                plan, scene(plan, coloured, (low, high), axes), [plot for plot in some.values() if plot]
            )
            for plan, some in zip(plans, plotted, strict=True)
        ],
    }
    parts = [
        SCENE_ROBOT_PART,
        *([SCENE_WALL_PART] if any(plan.wall is not None for plan in plans) else []),
        SCENE_TARGET_PART,
        SCENE_TARGET_END_PART,
        *([SCENE_FORCES_PART] if any(plan.wall_force is not None for plan in plans) else []),
    ]
    drawn = any(plan.drawn for plan in plans)
    return _render_page(
        plans=told,
        compared=_comparison_rows(told),
        data=data,
        frames=max(len(plan.time) for plan in plans),
        scales=[_legend(scale) for scale in coloured],
        tubes=[tube_colour(i) for i in range(max(plan.robot.d for plan in plans))],
        parts=[*parts, SAMPLED_ROBOTS_PART] if drawn else parts,
        ghosts={"kept": REPORT_GHOST_COLOUR, "lost": REPORT_FAILED_GHOST_COLOUR, "part": SAMPLED_ROBOTS_PART}
        if drawn
        else None,
        by_tube=TUBE_COLOURING,
        wall_forces={
            "part": SCENE_FORCES_PART,
            "colour": WALL_FORCE_COLOUR,
            "scales": list(
                dict.fromkeys(describe_force_lines(plan) for plan in plans if plan.wall_force is not None)
            ),
        },
        target_end={
            "part": SCENE_TARGET_END_PART,
            "colour": SCENE_TARGET_END_COLOUR,
            "radius": " or ".join(dict.fromkeys(f"{arrival_tolerance(plan):g}" for plan in plans)),
        },
    )


def _render_page(**values: Any) -> str:
    """Fill the page's template with values, style and script."""
    jinja2 = import_extra("jinja2")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, finalize=_as_text
    )
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    code = "\n".join(_text(name) for name in PAGE_SCRIPT_FILES)
    fixed = {
        "style": _text("page.css"),
        "code": code,
        "signs": VERDICT_SIGNS,
        "unchecked": NOT_CHECKED,
        "for_patients": summary_text.NOT_FOR_PATIENTS,
        "speeds": PAGE_PLAYBACK_SPEEDS,
        "extent": EXTENT,
    }
    return str(environment.from_string(_text("page.html")).render(**fixed, **values))


def _as_text(value: Any) -> Any:
    """Prepare a value for the template: a string is escaped, and parts of the page stay as they are."""
    return escape_control_characters(value) if isinstance(value, str) and not hasattr(value, "__html__") else value


def _plan_texts(plan: Plan, name: str) -> dict[str, Any]:
    """Return the texts of the page on a plan: title, verdicts, numbers, remarks, simulated robots and summary."""
    found = summary(plan)
    return {
        "title": summary_text.headline(plan),
        "method": summary_text.describe_method(found),
        "name": name,
        "lead": summary_text.summarise_verdicts(found),
        "verdicts": summary_text.verdict_rows(found),
        "chips": [_chip(verdict) for verdict in plan.verdicts],
        "sample_contact": _sample_contact(plan),
        "rows": [
            (row, summary_text.format_cell(value), unit) for row, value, unit in summary_text.measure_rows(found)
        ],
        "remarks": summary_text.remarks(plan, found),
        "drawn": _simulated_robot_texts(plan),
        "summary": json.dumps(found, indent=2, allow_nan=False, ensure_ascii=False).split("\n"),
    }


def _chip(verdict: Verdict) -> dict[str, str]:
    """Return a verdict as a chip of the page: matter, word, the figure that decides in words, and why."""
    # The reason has the frame, the limit and the number of robots, for which a chip has no room.
    figure = re.split(r",| (?:in|at) frame| of the limit| of \d+$", verdict.value)[0]
    return {"matter": verdict.matter, "word": verdict.word, "figure": figure, "why": verdict.why}


def _sample_contact(plan: Plan) -> str:
    """Say how deep simulated robots press into the wall, and what is not known of it; empty without any."""
    if plan.drawn is None or plan.wall is None:
        return ""
    least = plan.drawn.clearances
    if least is None:
        return f"Contact of sampled robots: {NOT_CHECKED}."
    known = f"{_clear_or_deep(least.median)} in the median, {_clear_or_deep(least.most)} or worse in 5 % of them"
    return f"Sampled robots over the whole motion: {known}. Their contact frame by frame is not kept in a plan."


def _clear_or_deep(clearance: float) -> str:
    """Return a clearance in mm in words: contact where it is negative."""
    return f"{-clearance:.2f} mm of contact" if clearance < 0 else f"{clearance:.2f} mm clear"


def _checker_rows(opinions: Sequence[Opinion]) -> list[dict[str, Any]]:
    """Return rows on an independent check: matter, what the checker and the plan say, whether they disagree."""
    return [
        {
            "matter": each.name.replace("_", " "),
            "found": _word_with_number(each.word, each.number),
            "own": "DISAGREES" * (not each.agrees)
            + (f" the plan says {_word_with_number(each.own_word, each.own_number)}" if each.own_word else ""),
            "why": each.why,
            "disagrees": not each.agrees,
        }
        for each in opinions
    ]


def _word_with_number(word: str, value: float | None) -> str:
    """Return the word of a verdict, with its number where it has one."""
    return word if value is None else f"{word} ({summary_text.format_cell(value)})"


def _comparison_rows(texts: Sequence[dict[str, Any]]) -> list[tuple[str, list[str], str]]:
    """Return the rows of the table that compares plans: name, a cell for each plan, and unit.

    texts: of each plan, from _plan_texts. A cell is empty where a plan does not have the number. Verdicts come
    first: their words with the figures that decide.
    """
    tables = [{row: (value, unit) for row, value, unit in some["rows"]} for some in texts]
    named = {row: unit for table in tables for row, (_, unit) in table.items()}
    words = [{matter: (word, value) for matter, word, value, _ in some["verdicts"]} for some in texts]
    return [
        *((matter, [", ".join(filter(None, some[matter])) for some in words], "") for matter in words[0]),
        *((row, [table.get(row, ("", ""))[0] for table in tables], unit) for row, unit in named.items()),
    ]


def _simulated_robot_texts(plan: Plan) -> dict[str, Any] | None:
    """Return the texts of the page on the simulated robots of a plan; None where there are none."""
    if plan.drawn is None:
        return None
    count = len(plan.drawn)
    shown = f"the first {MAX_REPORT_GHOSTS} of them" if count > MAX_REPORT_GHOSTS else "them"
    lead = (
        f"{count} robots within the tolerances were sampled at random (seed {plan.drawn.seed}) and moved open "
        f"loop through this plan; “{SAMPLED_ROBOTS_PART}” in the list of what is shown switches {shown} on and "
        f"off."
    )
    return {
        "matter": plan.verdicts.holds.matter,
        "sentences": [
            plan.verdicts.holds.why,
            plan.drawn.summary_sentence,
            *sample_text.robustness_sentences(plan.drawn),
            lead,
        ],
        "tables": [
            table._replace(rows=[tuple(summary_text.format_cell(cell) for cell in row) for row in table.rows])
            for table in sample_text.tables(plan)
        ],
    }


def _animation_data(plan: Plan, packed: str, shown: Sequence[Plot]) -> dict[str, Any]:
    """Return the data for the script to show a plan's frames; `packed` is its scene, `shown` are its plots."""
    columns = by_frame(plan)
    to_go = way_to_go(plan)
    return {
        "scene": packed,
        "time": plan.time.tolist(),
        "reached": plan.reached_frames.tolist(),
        "solved": plan.success.tolist(),
        "eyes": eyes(plan),
        "toGo": {
            "distance": _round_values(to_go.distance),
            "angle": _round_values(to_go.angle_deg),
            "allowed": arrival_tolerance(plan),
        },
        "coordinates": coordinates(plan),
        "prints": [each._asdict() for each in printed_frames(plan, columns["e2"])],
        "colourings": [TUBE_COLOURING, *quantities(plan)],
        "plots": [{"end": plot.end, "lines": [_round_values(values) for values in plot.values]} for plot in shown],
        "readout": {
            name: {"label": label, "unit": unit, "values": _round_values(columns[name])}
            for name, (label, unit) in READOUT.items()
            if name in columns
        },
    }


def _round_values(values: Array) -> list[float | None]:
    """Round numbers to four significant digits; None where there is none."""
    return [float(f"{value:.4g}") if np.isfinite(value) else None for value in values]


def _legend(scale: ColourScale) -> dict[str, Any]:
    """Return a colour scale's legend for the template; zero: where 0 is, percent of its length."""
    gradient = ", ".join(f"{colour} {100 * at:.2f}%" for at, colour in scale.stops)
    zero = 100 * (0.0 - scale.low) / (scale.high - scale.low)
    told = {"key": scale.key, "name": scale.name, "zero": zero, "high": f"{scale.high:.3g}"}
    return told | {"gradient": f"linear-gradient(90deg, {gradient})"}


def _text(name: str) -> str:
    """Read a file of the page by its name."""
    return resources.files("ctr_nlp.view.report").joinpath(name).read_text(encoding="utf-8")
