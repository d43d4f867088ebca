"""One HTML file with everything in it: scenes, plots, numbers, and the script that keeps them in step."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib import resources
from typing import Any

import numpy as np

from ctr_nlp.exceptions import OptionError, escaped
from ctr_nlp.figures.parts.palette import tube_colour
from ctr_nlp.plan import account, drawn_account
from ctr_nlp.plan.metrics import by_frame, summary
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.verdicts import NO, NOT_CHECKED, YES
from ctr_nlp.report.camera import EYE_FIELD, FIELD, cameras, eyes
from ctr_nlp.report.ghosts import DRAWS, KEPT, LOST, SHOWN
from ctr_nlp.report.plots import EXTENT, Plot, plots
from ctr_nlp.report.scene import BY_TUBE, DATA, ROBOT, TARGET, WALLS, Scale, box, frame, quantities, scales, scene
from ctr_nlp.support.extras import needed
from ctr_nlp.typing import Array

READOUT = {"e2": "mm", "max": "mm", "clearance": "mm", "stability": ""}
"""Columns of errors.csv that are shown for the frame on display, with their units."""
CODE = ("scenes.js", "camera.js", "player.js", "page.js")
"""The script of the page, in the order in which its parts need each other."""
SIGNS = {YES: "\N{CHECK MARK}", NO: "\N{BALLOT X}", NOT_CHECKED: "?"}
"""Signs beside the word of a verdict, as a colour does not tell it to everyone."""
SPEEDS = ("0.25", "0.5", "1", "2", "4")
"""Speeds of playing, as multiples of the plan's own."""


def page(plans: Sequence[Plan], names: Sequence[str] | None = None) -> str:
    """Make a page for one plan, or for several side by side in step; it needs no other file and no network.

    names: what to call each plan besides its title, such as its file. Raises OptionError without plans, or where
    the extra `report` is not installed.
    """
    if not plans:
        raise OptionError("plans is empty; give at least one")
    coloured, (low, high), plotted = scales(plans), box(plans), plots(plans)
    told = [
        _told(plan, name) | {"plots": some.items()}
        for plan, name, some in zip(plans, names or [""] * len(plans), plotted, strict=True)
    ]
    data = {
        "template": frame(),
        "placeholder": DATA,
        "cameras": cameras(low, high),
        "fields": {"outside": FIELD, "eye": EYE_FIELD},
        "plans": [
            _moving(plan, scene(plan, coloured, low, high), [plot for plot in some.values() if plot])
            for plan, some in zip(plans, plotted, strict=True)
        ],
    }
    parts = [ROBOT, *([WALLS] if any(plan.lumen is not None for plan in plans) else []), TARGET]
    drawn = any(plan.drawn for plan in plans)
    return _rendered(
        plans=told,
        compared=_compared(told),
        data=data,
        frames=max(len(plan.time) for plan in plans),
        scales=[_legend(scale) for scale in coloured],
        tubes=[tube_colour(i) for i in range(max(plan.robot.d for plan in plans))],
        parts=[*parts, DRAWS] if drawn else parts,
        ghosts={"kept": KEPT, "lost": LOST, "part": DRAWS} if drawn else None,
        by_tube=BY_TUBE,
    )


def _rendered(**values: Any) -> str:
    """Fill the page's template with values, style and script."""
    jinja2 = needed("jinja2")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, finalize=_as_text
    )
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    code = "\n".join(_text(name) for name in CODE)
    fixed = {
        "style": _text("page.css"),
        "code": code,
        "signs": SIGNS,
        "unchecked": NOT_CHECKED,
        "for_patients": account.NOT_FOR_PATIENTS,
        "speeds": SPEEDS,
        "extent": EXTENT,
    }
    return str(environment.from_string(_text("page.html")).render(**fixed, **values))


def _as_text(value: Any) -> Any:
    """Prepare a value for the template: a string is escaped, and parts of the page stay as they are."""
    return escaped(value) if isinstance(value, str) and not hasattr(value, "__html__") else value


def _told(plan: Plan, name: str) -> dict[str, Any]:
    """Return the texts of the page on a plan: title, verdicts, numbers, remarks, simulated robots and summary."""
    found = summary(plan)
    return {
        "title": account.title(found),
        "name": name,
        "lead": account.lead(found),
        "verdicts": account.verdict_rows(found),
        "rows": [(row, account.shown(value), unit) for row, value, unit in account.rows(found)],
        "remarks": account.remarks(plan, found),
        "drawn": _drawn(plan),
        "summary": json.dumps(found, indent=2, allow_nan=False, ensure_ascii=False).split("\n"),
    }


def _compared(told: Sequence[dict[str, Any]]) -> list[tuple[str, list[str], str]]:
    """Rows of the table that compares plans.

    Returns
    -------
    list of (str, list of str, str)
        A name, a cell for each plan, empty where a plan does not have the number, and a unit. Verdicts come first:
        their words with the figures that decide.
    """
    tables = [{row: (value, unit) for row, value, unit in some["rows"]} for some in told]
    named = {row: unit for table in tables for row, (_, unit) in table.items()}
    words = [{matter: (word, value) for matter, word, value, _ in some["verdicts"]} for some in told]
    return [
        *((matter, [", ".join(filter(None, some[matter])) for some in words], "") for matter in words[0]),
        *((row, [table.get(row, ("", ""))[0] for table in tables], unit) for row, unit in named.items()),
    ]


def _drawn(plan: Plan) -> dict[str, Any] | None:
    """Return the texts of the page on the simulated robots of a plan; None where there are none."""
    if plan.drawn is None:
        return None
    count = len(plan.drawn)
    shown = f"the first {SHOWN} of them" if count > SHOWN else "them"
    lead = (
        f"{count} robots within the tolerances were sampled at random (seed {plan.drawn.seed}) and moved open "
        f"loop through this plan; “{DRAWS}” in the list of what is shown switches {shown} on and off."
    )
    return {
        "matter": plan.verdicts.holds.matter,
        "sentences": [plan.verdicts.holds.why, plan.drawn.told, *drawn_account.sentences(plan.drawn), lead],
        "tables": [
            table._replace(rows=[tuple(account.shown(cell) for cell in row) for row in table.rows])
            for table in drawn_account.tables(plan)
        ],
    }


def _moving(plan: Plan, packed: str, shown: Sequence[Plot]) -> dict[str, Any]:
    """Return the data for the script to show a plan's frames; `packed` is its scene, `shown` are its plots."""
    columns = by_frame(plan)
    return {
        "scene": packed,
        "time": plan.time.tolist(),
        "reached": plan.reached.tolist(),
        "solved": plan.success.tolist(),
        "eyes": eyes(plan),
        "colourings": [BY_TUBE, *quantities(plan)],
        "plots": [{"end": plot.end, "lines": [_rounded(values) for values in plot.values]} for plot in shown],
        "readout": {
            name: {"unit": unit, "values": _rounded(columns[name])}
            for name, unit in READOUT.items()
            if name in columns
        },
    }


def _rounded(values: Array) -> list[float | None]:
    """Round numbers to four significant digits; None where there is none."""
    return [float(f"{value:.4g}") if np.isfinite(value) else None for value in values]


def _legend(scale: Scale) -> dict[str, Any]:
    gradient = ", ".join(f"{colour} {100 * at:.2f}%" for at, colour in scale.stops)
    zero = 100 * (0.0 - scale.low) / (scale.high - scale.low)
    told = {"key": scale.key, "name": scale.name, "zero": zero, "high": f"{scale.high:.3g}"}
    return told | {"gradient": f"linear-gradient(90deg, {gradient})"}


def _text(name: str) -> str:
    return resources.files("ctr_nlp.report").joinpath(name).read_text(encoding="utf-8")
