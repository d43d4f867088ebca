"""One HTML file with everything in it: scenes, plots, numbers, and the script that keeps them in step."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib import resources
from typing import Any

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.figures.parts.palette import tube_colour
from ctr_nlp.plan import account, drawn_account
from ctr_nlp.plan.metrics import by_frame, summary
from ctr_nlp.plan.plan import Plan
from ctr_nlp.report.ghosts import KEPT, LOST, SHOWN
from ctr_nlp.report.plots import cursors, figures
from ctr_nlp.report.scene import BY_TUBE, DATA, Scale, box, frame, quantities, scales, scene
from ctr_nlp.support.extras import needed

READOUT = {"e2": "mm", "max": "mm", "clearance": "mm", "stability": ""}
"""Columns of errors.csv that are told of the frame that is shown, with their units."""


def page(plans: Sequence[Plan], names: Sequence[str] | None = None) -> str:
    """A page for one plan, or for several side by side in step; it needs no other file and no network.

    names: what to call each plan besides its title, such as its file. Raises OptionError without plans, or where
    the extra `report` is not installed.
    """
    if not plans:
        raise OptionError("plans is empty; give at least one")
    embed, inline = needed("bokeh.embed"), needed("bokeh.resources").Resources(mode="inline", components=["bokeh"])
    coloured = scales(plans)
    low, high = box(plans)
    scenes = [scene(plan, coloured, low, high) for plan in plans]
    plotted = figures(plans)
    script, divs = embed.components([figure for some in plotted for figure in some.values() if figure])
    rest = iter(divs)
    shown = [
        _told(plan, name) | {"plots": [(panel, next(rest) if figure else None) for panel, figure in some.items()]}
        for plan, name, some in zip(plans, names or [""] * len(plans), plotted, strict=True)
    ]
    data = {
        "template": frame(),
        "placeholder": DATA,
        "plans": [
            _moving(plan, packed, cursors(filter(None, some.values())))
            for plan, packed, some in zip(plans, scenes, plotted, strict=True)
        ],
    }
    jinja2 = needed("jinja2")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False}
    return str(
        environment.from_string(_text("page.html")).render(
            plans=shown,
            data=data,
            frames=max(len(plan.time) for plan in plans),
            scales=[_legend(scale) for scale in coloured],
            tubes=[tube_colour(i) for i in range(max(plan.robot.d for plan in plans))],
            ghosts={"kept": KEPT, "lost": LOST} if any(plan.drawn for plan in plans) else None,
            by_tube=BY_TUBE,
            style=_text("page.css"),
            code=_text("page.js"),
            bokeh=inline.render_js(),
            plots=script,
        )
    )


def _told(plan: Plan, name: str) -> dict[str, Any]:
    """What is written about a plan."""
    found = summary(plan)
    return {
        "title": account.title(found),
        "name": name,
        "verdicts": account.verdict_rows(found),
        "rows": [(row, account.shown(value), unit) for row, value, unit in account.rows(found)],
        "remarks": account.remarks(plan, found),
        "drawn": _drawn(plan),
        "summary": json.dumps(found, indent=2, allow_nan=False, ensure_ascii=False),
    }


def _drawn(plan: Plan) -> dict[str, Any] | None:
    """What is written of the robots that a plan was tried on; None where there are none."""
    if plan.drawn is None:
        return None
    count = len(plan.drawn)
    shown = f"the first {SHOWN} of them" if count > SHOWN else "them"
    lead = (
        f"{count} robots within the tolerances were drawn at random (seed {plan.drawn.seed}) and moved open loop "
        f"through this plan; “drawn robots” above shows {shown}."
    )
    return {
        "matter": plan.verdicts.survives_draws.matter,
        "sentences": [plan.verdicts.survives_draws.why, *drawn_account.sentences(plan.drawn), lead],
        "tables": [
            table._replace(rows=[tuple(account.shown(cell) for cell in row) for row in table.rows])
            for table in drawn_account.tables(plan.drawn)
        ],
    }


def _moving(plan: Plan, packed: str, spans: list[str]) -> dict[str, Any]:
    """What the script needs to show a plan's frames."""
    columns = by_frame(plan)
    return {
        "scene": packed,
        "time": plan.time.tolist(),
        "reached": plan.reached.tolist(),
        "solved": plan.success.tolist(),
        "cursors": spans,
        "colourings": [BY_TUBE, *quantities(plan)],
        "readout": {
            name: {
                "unit": unit,
                "values": [float(f"{value:.4g}") if np.isfinite(value) else None for value in columns[name]],
            }
            for name, unit in READOUT.items()
            if name in columns
        },
    }


def _legend(scale: Scale) -> dict[str, Any]:
    gradient = ", ".join(f"{colour} {100 * at:.2f}%" for at, colour in scale.stops)
    zero = 100 * (0.0 - scale.low) / (scale.high - scale.low)
    told = {"key": scale.key, "name": scale.name, "zero": zero, "high": f"{scale.high:.3g}"}
    return told | {"gradient": f"linear-gradient(90deg, {gradient})"}


def _text(name: str) -> str:
    return resources.files("ctr_nlp.report").joinpath(name).read_text(encoding="utf-8")
