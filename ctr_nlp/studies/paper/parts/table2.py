"""Table II: errors on both models and times, published, re-implemented and ours."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ctr_nlp.models import model_named
from ctr_nlp.plan.account import shown
from ctr_nlp.reference import published
from ctr_nlp.reference.learned.network import place
from ctr_nlp.robot.paper import table_i_robot
from ctr_nlp.studies.paper.checks import Check, listed, named, number, order, orders
from ctr_nlp.studies.paper.runs import BASELINE, ELASTIC, HORIZON, JOINT, NAMES, OURS, S2J, SEED, Found
from ctr_nlp.studies.paper.section import ALL, COMPARABLE, Section, Table, mm, motions

LEARNED = (S2J,) if place(table_i_robot(), "dominant").exists() else ()
"""S2J-IK where there is a network for the paper's robot when this is loaded; else empty."""
METHODS = SEED, BASELINE, *LEARNED, JOINT, HORIZON, ELASTIC
MODELS = {"dominant": "stiffness", "elastic": "compliant"}
"""What the paper calls the models, by what they are called here."""
PRINTED: dict[tuple[str, str], Mapping[str, tuple[float, ...]]] = {
    ("dominant", SEED): published.SEED,
    ("dominant", BASELINE): published.BASELINE,
    ("elastic", SEED): published.SEED_ELASTIC,
    ("elastic", BASELINE): published.BASELINE_ELASTIC,
}
"""(e3, e4, ..) in mm by problem, for each model and method of the paper."""
PRINTED_NAMES = {SEED: "the paper (published)", BASELINE: "its baseline (published)"}


def tables(found: Found) -> list[Table]:
    """Return the table itself in three parts: errors on each model, and times."""
    header = ["method", *(f"`{problem}`" for problem in ALL)]
    parts = []
    for model, name in MODELS.items():
        body = []
        for method in METHODS:
            if (model, method) in PRINTED:
                pairs = (PRINTED[model, method][problem] for problem in ALL)
                body.append([PRINTED_NAMES[method], *(" / ".join(f"{x:.2f}" for x in pair[:2]) for pair in pairs)])
            body.append([NAMES[method], *(_cell(found, problem, method, model) for problem in ALL)])
        parts.append(Table(f"e3 / e4 in mm on the {name} model", header, body))
    times = []
    for method in METHODS:
        if ("dominant", method) in PRINTED:
            of = PRINTED["dominant", method]
            times.append([PRINTED_NAMES[method], *(f"{1e3 * of[problem][2]:.0f}" for problem in ALL)])
        times.append([NAMES[method], *(shown(milliseconds(found, problem, method)) for problem in ALL)])
    return [*parts, Table("t_c, time a frame in ms", header, times)]


def _cell(found: Found, problem: str, method: str, model: str) -> str:
    """Write e3 / e4 of a run; those of ours in bold where they are lower than the paper's own, published."""
    row = found.row(problem, method)
    texts = []
    for key, limit in zip(("e3", "e4"), PRINTED[model, SEED][problem], strict=False):
        value = row[f"{model}_{key}"]
        lower = method in OURS and problem in COMPARABLE and order(number(value), limit) == "lower"
        texts.append(f"**{mm(value)}**" if lower else mm(value))
    return " / ".join(texts) + "*" * (row["failed"] > 0) + "!" * (model_named(model).can_snap and row["snaps"] > 0)


def milliseconds(found: Found, problem: str, method: str) -> float:
    """Return the mean time a frame in ms: in the solver; where all frames are solved at once, also for the start
    of that.
    """
    row = found.row(problem, method)
    start = number(row["search_s"]) if method in (HORIZON, ELASTIC) else 0.0
    return 1e3 * (row["total_s"] + start) / found.frames


def checks(found: Found) -> list[Check]:
    """Check the paper's conclusions from its table, and compare ours with the published figures."""
    return [
        *(_better(found, model) for model in MODELS),
        _faster(found),
        *(_against(found, model, method) for model in MODELS for method in (SEED, BASELINE)),
        *(_against(found, model, method) for model in MODELS for method in (JOINT, HORIZON)),
        _against(found, "elastic", ELASTIC),
    ]


def _better(found: Found, model: str) -> Check:
    """Compare the paper's method with its baseline, both re-implemented."""
    lower = {p: _value(found, p, SEED, model, "e3") < _value(found, p, BASELINE, model, "e3") for p in ALL}
    printed = sum(PRINTED[model, SEED][p][0] < PRINTED[model, BASELINE][p][0] for p in ALL)
    return Check(
        f"its method has a lower e3 than its baseline on the {MODELS[model]} model, as published on {printed} of "
        f"{len(ALL)}",
        f"with both re-implemented, it is lower {named(lower)}",
        sum(lower.values()),
        len(lower),
    )


def _faster(found: Found) -> Check:
    """Compare times of the paper's method and its baseline as ratios, since machines differ."""
    times = {m: {p: milliseconds(found, p, m) for p in ALL} for m in METHODS}
    ratios = sorted(times[BASELINE][p] / times[SEED][p] for p in ALL)
    printed = sorted(published.BASELINE[p][2] / published.SEED[p][2] for p in ALL)
    faster = {p: times[SEED][p] < times[BASELINE][p] for p in ALL}
    ours = "; ".join(
        f"{NAMES[m]}: {shown(min(times[m].values()))} to {shown(max(times[m].values()))} ms"
        for m in (JOINT, HORIZON, ELASTIC)
    )
    mine, base = ([f(times[m].values()) for f in (min, max)] for m in (SEED, BASELINE))
    return Check(
        "its method takes less time a frame than its baseline",
        f"published are {printed[0]:.1f} to {printed[-1]:.1f} times less; re-implemented, it takes "
        f"{shown(mine[0])} to {shown(mine[1])} ms and the baseline {shown(base[0])} to {shown(base[1])} ms, "
        f"{ratios[0]:.1f} to {ratios[-1]:.1f} times as long; it is faster {named(faster)}. Times of {ours}",
        sum(faster.values()),
        len(faster),
    )


def _against(found: Found, model: str, method: str) -> Check:
    """Compare e3 and e4 of a method with what is published of the paper's own, or of the same method."""
    same = method if method in PRINTED_NAMES else SEED
    pairs = {
        key: {p: (_value(found, p, method, model, key), PRINTED[model, same][p][k]) for p in COMPARABLE}
        for k, key in enumerate(("e3", "e4"))
    }
    holds = [order(*pair) != "higher" for some in pairs.values() for pair in some.values()]
    said = "; ".join(f"{key} is {orders(some)}" for key, some in pairs.items())
    return Check(
        f"{MODELS[model]} model, {NAMES[method]}: e3 and e4 are at most those of {PRINTED_NAMES[same]}",
        said,
        sum(holds),
        len(holds),
        asked=True,
    )


def _value(found: Found, problem: str, method: str, model: str, key: str) -> float:
    return number(found.row(problem, method)[f"{model}_{key}"])


def rows(found: Found) -> list[dict[str, Any]]:
    """Return a line for each method and problem, as printed and as found here; mm and ms."""
    result: list[dict[str, Any]] = []
    for method in METHODS:
        for problem in ALL:
            if method in PRINTED_NAMES:
                (e3, e4, seconds), compliant = (PRINTED[model, method][problem] for model in MODELS)
                printed = [e3, e4, *compliant, 1e3 * seconds]
                result.append(_line(PRINTED_NAMES[method], problem, printed, "", ""))
            row = found.row(problem, method)
            values = [row[f"{model}_{key}"] for model in MODELS for key in ("e3", "e4")]
            values.append(milliseconds(found, problem, method))
            result.append(_line(method, problem, values, row["failed"], row["snaps"]))
    return result


def _line(method: str, problem: str, values: list[Any], failed: Any, snaps: Any) -> dict[str, Any]:
    keys = [*(f"{name}_{key}_mm" for name in MODELS.values() for key in ("e3", "e4")), "t_c_ms"]
    numbers = dict(zip(keys, values, strict=True))
    return {"method": method, "problem": problem, **numbers, "failed": failed, "snaps": snaps}


SECTION = Section(
    "table2",
    "Table II: errors on both models, and times",
    motions(ALL, METHODS),
    "All but the last row of each part plan on the stiffness-dominant model; the compliant part shows what the "
    "same motions come to on that model, and in its last row what a plan made on it does. S2J-IK, the paper's "
    "[7], has a row where `ctr-nlp learn` has trained a network for the paper's robot. Bold: ours, lower "
    f"than the paper's own published figure (not for {listed([f'`{p}`' for p in ALL if p not in COMPARABLE])}, "
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
