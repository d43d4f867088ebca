"""Table II: errors on both models and times; published, re-implemented and ours."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from reference import published
from reference.learned.network import network_path

from ctr_nlp.models import model_named
from ctr_nlp.plan.summary_text import format_cell
from ctr_nlp.robot.paper import table_i_robot
from paper.checks import Check, compare_with_published, join_names, number, summarise_comparison, where_it_holds
from paper.runs import (
    EUCLIDEAN_BASELINE,
    OUR_ELASTIC_HORIZON,
    OUR_HORIZON,
    OUR_JOINT,
    OUR_METHODS,
    PAPER_METHOD_LABELS,
    PAPER_TWO_STAGE,
    S2J_PROJECTED,
    PaperResults,
)
from paper.section import (
    COMPARABLE_PROBLEMS,
    TABLE_II_PROBLEMS,
    CaptionedTable,
    PaperSection,
    format_mm,
    motion_tasks,
)

LEARNED_METHODS = (S2J_PROJECTED,) if network_path(table_i_robot(), "dominant").exists() else ()
"""S2J-IK, where a network for the paper's robot exists when this module is loaded; else empty."""
TABLE_II_METHODS = (
    PAPER_TWO_STAGE,
    EUCLIDEAN_BASELINE,
    *LEARNED_METHODS,
    OUR_JOINT,
    OUR_HORIZON,
    OUR_ELASTIC_HORIZON,
)
TABLE_II_MODEL_NAMES = {"dominant": "stiffness", "elastic": "compliant"}
"""The paper's names of the models, by ours."""
TABLE_II_PUBLISHED: dict[tuple[str, str], Mapping[str, tuple[float, ...]]] = {
    ("dominant", PAPER_TWO_STAGE): published.TABLE_II_PAPER_METHOD,
    ("dominant", EUCLIDEAN_BASELINE): published.TABLE_II_BASELINE,
    ("elastic", PAPER_TWO_STAGE): published.TABLE_II_PAPER_METHOD_ELASTIC,
    ("elastic", EUCLIDEAN_BASELINE): published.TABLE_II_BASELINE_ELASTIC,
}
"""(e3, e4, ..) in mm by problem, for each model and method of the paper."""
PUBLISHED_METHOD_NAMES = {PAPER_TWO_STAGE: "the paper (published)", EUCLIDEAN_BASELINE: "its baseline (published)"}


def tables(found: PaperResults) -> list[CaptionedTable]:
    """Return Table II in three parts: errors on each model, and times; found: results of the run."""
    header = ["method", *(f"`{problem}`" for problem in TABLE_II_PROBLEMS)]
    parts = []
    for model, name in TABLE_II_MODEL_NAMES.items():
        body = []
        for method in TABLE_II_METHODS:
            if (model, method) in TABLE_II_PUBLISHED:
                pairs = (TABLE_II_PUBLISHED[model, method][problem] for problem in TABLE_II_PROBLEMS)
                body.append(
                    [PUBLISHED_METHOD_NAMES[method], *(" / ".join(f"{x:.2f}" for x in pair[:2]) for pair in pairs)]
                )
            body.append(
                [
                    PAPER_METHOD_LABELS[method],
                    *(_cell(found, problem, method, model) for problem in TABLE_II_PROBLEMS),
                ]
            )
        parts.append(CaptionedTable(f"e3 / e4 in mm on the {name} model", header, body))
    times = []
    for method in TABLE_II_METHODS:
        if ("dominant", method) in TABLE_II_PUBLISHED:
            of = TABLE_II_PUBLISHED["dominant", method]
            times.append(
                [PUBLISHED_METHOD_NAMES[method], *(f"{1e3 * of[problem][2]:.0f}" for problem in TABLE_II_PROBLEMS)]
            )
        times.append(
            [
                PAPER_METHOD_LABELS[method],
                *(format_cell(milliseconds(found, problem, method)) for problem in TABLE_II_PROBLEMS),
            ]
        )
    return [*parts, CaptionedTable("t_c, time a frame in ms", header, times)]


def _cell(found: PaperResults, problem: str, method: str, model: str) -> str:
    """Write e3 / e4 of a run; ours in bold where they are lower than the published ones of the paper's method."""
    row = found.row(problem, method)
    texts = []
    for key, limit in zip(("e3", "e4"), TABLE_II_PUBLISHED[model, PAPER_TWO_STAGE][problem], strict=False):
        value = row[f"{model}_{key}"]
        lower = (
            method in OUR_METHODS
            and problem in COMPARABLE_PROBLEMS
            and compare_with_published(number(value), limit) == "lower"
        )
        texts.append(f"**{format_mm(value)}**" if lower else format_mm(value))
    return " / ".join(texts) + "*" * (row["failed"] > 0) + "!" * (model_named(model).can_snap and row["snaps"] > 0)


def milliseconds(found: PaperResults, problem: str, method: str) -> float:
    """Return the mean time per frame in ms of a method on a problem, in the results `found`.

    That of the solver; where all frames are solved at once, the time of the start motions counts, too.
    """
    row = found.row(problem, method)
    start = number(row["search_s"]) if method in (OUR_HORIZON, OUR_ELASTIC_HORIZON) else 0.0
    return 1e3 * (row["total_s"] + start) / found.frames


def checks(found: PaperResults) -> list[Check]:
    """Check the paper's conclusions from its table against the results `found`, and compare with its figures."""
    return [
        *(_compare_errors(found, model) for model in TABLE_II_MODEL_NAMES),
        _compare_times(found),
        *(
            _compare_published(found, model, method)
            for model in TABLE_II_MODEL_NAMES
            for method in (PAPER_TWO_STAGE, EUCLIDEAN_BASELINE)
        ),
        *(
            _compare_published(found, model, method)
            for model in TABLE_II_MODEL_NAMES
            for method in (OUR_JOINT, OUR_HORIZON)
        ),
        _compare_published(found, "elastic", OUR_ELASTIC_HORIZON),
    ]


def _compare_errors(found: PaperResults, model: str) -> Check:
    """Compare the paper's method with its baseline, both re-implemented."""
    lower = {
        p: _value(found, p, PAPER_TWO_STAGE, model, "e3") < _value(found, p, EUCLIDEAN_BASELINE, model, "e3")
        for p in TABLE_II_PROBLEMS
    }
    printed = sum(
        TABLE_II_PUBLISHED[model, PAPER_TWO_STAGE][p][0] < TABLE_II_PUBLISHED[model, EUCLIDEAN_BASELINE][p][0]
        for p in TABLE_II_PROBLEMS
    )
    return Check(
        f"its method has a lower e3 than its baseline on the {TABLE_II_MODEL_NAMES[model]} model, as published "
        f"on {printed} of "
        f"{len(TABLE_II_PROBLEMS)}",
        f"with both re-implemented, it is lower {where_it_holds(lower)}",
        sum(lower.values()),
        len(lower),
    )


def _compare_times(found: PaperResults) -> Check:
    """Compare times of the paper's method and its baseline as ratios, since machines differ."""
    # Absolute times are of another machine; ratios of two methods on one machine can be compared.
    times = {m: {p: milliseconds(found, p, m) for p in TABLE_II_PROBLEMS} for m in TABLE_II_METHODS}
    ratios = sorted(times[EUCLIDEAN_BASELINE][p] / times[PAPER_TWO_STAGE][p] for p in TABLE_II_PROBLEMS)
    printed = sorted(
        published.TABLE_II_BASELINE[p][2] / published.TABLE_II_PAPER_METHOD[p][2] for p in TABLE_II_PROBLEMS
    )
    faster = {p: times[PAPER_TWO_STAGE][p] < times[EUCLIDEAN_BASELINE][p] for p in TABLE_II_PROBLEMS}
    ours = "; ".join(
        f"{PAPER_METHOD_LABELS[m]}: {format_cell(min(times[m].values()))} to "
        f"{format_cell(max(times[m].values()))} ms"
        for m in (OUR_JOINT, OUR_HORIZON, OUR_ELASTIC_HORIZON)
    )
    mine, base = ([f(times[m].values()) for f in (min, max)] for m in (PAPER_TWO_STAGE, EUCLIDEAN_BASELINE))
    return Check(
        "its method takes less time a frame than its baseline",
        f"published are {printed[0]:.1f} to {printed[-1]:.1f} times less; re-implemented, it takes "
        f"{format_cell(mine[0])} to {format_cell(mine[1])} ms and the baseline {format_cell(base[0])} to "
        f"{format_cell(base[1])} ms, "
        f"{ratios[0]:.1f} to {ratios[-1]:.1f} times as long; it is faster {where_it_holds(faster)}. Times of "
        f"{ours}",
        sum(faster.values()),
        len(faster),
    )


def _compare_published(found: PaperResults, model: str, method: str) -> Check:
    """Compare e3 and e4 of a method with the published ones of the same method, or else of the paper's."""
    same = method if method in PUBLISHED_METHOD_NAMES else PAPER_TWO_STAGE
    pairs = {
        key: {
            p: (_value(found, p, method, model, key), TABLE_II_PUBLISHED[model, same][p][k])
            for p in COMPARABLE_PROBLEMS
        }
        for k, key in enumerate(("e3", "e4"))
    }
    holds = [compare_with_published(*pair) != "higher" for some in pairs.values() for pair in some.values()]
    said = "; ".join(f"{key} is {summarise_comparison(some)}" for key, some in pairs.items())
    return Check(
        f"{TABLE_II_MODEL_NAMES[model]} model, {PAPER_METHOD_LABELS[method]}: e3 and e4 are at most those of "
        f"{PUBLISHED_METHOD_NAMES[same]}",
        said,
        sum(holds),
        len(holds),
        own_question=True,
    )


def _value(found: PaperResults, problem: str, method: str, model: str, key: str) -> float:
    return number(found.row(problem, method)[f"{model}_{key}"])


def rows(found: PaperResults) -> list[dict[str, Any]]:
    """Return a row for each method and problem, as printed and from the results `found`; mm and ms."""
    result: list[dict[str, Any]] = []
    for method in TABLE_II_METHODS:
        for problem in TABLE_II_PROBLEMS:
            if method in PUBLISHED_METHOD_NAMES:
                (e3, e4, seconds), compliant = (
                    TABLE_II_PUBLISHED[model, method][problem] for model in TABLE_II_MODEL_NAMES
                )
                printed = [e3, e4, *compliant, 1e3 * seconds]
                result.append(_line(PUBLISHED_METHOD_NAMES[method], problem, printed, "", ""))
            row = found.row(problem, method)
            values = [row[f"{model}_{key}"] for model in TABLE_II_MODEL_NAMES for key in ("e3", "e4")]
            values.append(milliseconds(found, problem, method))
            result.append(_line(method, problem, values, row["failed"], row["snaps"]))
    return result


def _line(method: str, problem: str, values: list[Any], failed: Any, snaps: Any) -> dict[str, Any]:
    keys = [*(f"{name}_{key}_mm" for name in TABLE_II_MODEL_NAMES.values() for key in ("e3", "e4")), "t_c_ms"]
    numbers = dict(zip(keys, values, strict=True))
    return {"method": method, "problem": problem, **numbers, "failed": failed, "snaps": snaps}


TABLE_II = PaperSection(
    "table2",
    "Table II: errors on both models, and times",
    motion_tasks(TABLE_II_PROBLEMS, TABLE_II_METHODS),
    "All but the last row of each part plan on the stiffness-dominant model; the compliant part shows what the "
    "same motions come to on that model, and in its last row what a plan made on it does. S2J-IK, the paper's "
    "[7], has a row where `scripts/studies/learn.py` has trained a network for the paper's robot. Bold: ours, "
    f"lower than the paper's own published figure (not for "
    f"{join_names([f'`{p}`' for p in TABLE_II_PROBLEMS if p not in COMPARABLE_PROBLEMS])}, "
    "where targets differ; statements on published numbers leave it out too). A star: some frames not solved. "
    "An exclamation mark: the robot snaps on the way. t_c is the time of a frame, on average, without the "
    "search for the first one; where all frames are solved at once, it has its share of all that a motion "
    "takes, that of the motions that it starts from included, and on a machine's first run compiling too. "
    "Processes side by side slow each other.",
    "The paper's compliant model needs a Poisson ratio, transmissions and stiffnesses that it does not give: "
    "ours has 0.3, straight transmissions of 40, 95 and 240 mm, and stiffnesses from Table I's diameters and "
    "one modulus. Its weights of the motion term have no unit. It names an Intel Core i5 at 4.1 GHz and Python. "
    "Its limits of speed, and where it starts from, are not known; our re-implementations go forward from the "
    "best of 32 starts.",
    tables,
    checks,
    rows,
)
