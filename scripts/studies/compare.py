"""`python scripts/studies/compare.py`: solve problems by several methods, side by side."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from methods.comparison import (
    VARIANTS,
    VARIANTS_BY_NAME_ONLY,
    Comparison,
    available_variants,
    compare,
    parse_variant,
)
from methods.metrics import every_method, measure_plan
from methods.page import page
from reference import REFERENCE_METHODS
from reference.published import (
    TABLE_II_BASELINE,
    TABLE_II_BASELINE_ELASTIC,
    TABLE_II_PAPER_METHOD,
    TABLE_II_PAPER_METHOD_ELASTIC,
)

from ctr_nlp.cli import arguments as options
from ctr_nlp.cli import problems
from ctr_nlp.cli.console import EXIT_INTERRUPTED, EXIT_SOLVED, EXIT_SOME_FAILED, Command
from ctr_nlp.cli.output.folder import check_folder, output_folder, results_folder
from ctr_nlp.cli.plan_options import add_file_options
from ctr_nlp.cli.plan_report import STYLES
from ctr_nlp.cli.terminal_output import console, print_table, progress_bar, report_written_files
from ctr_nlp.models import KINEMATIC_MODELS, model_named
from ctr_nlp.paths.named_problems import PROBLEM_NAMES
from ctr_nlp.plan.monte_carlo import DEFAULT_PLAN_SAMPLES
from ctr_nlp.plan.summary_text import format_cell
from ctr_nlp.plan.verdicts import NOT_CHECKED, SHORT_NAMES, Verdicts
from ctr_nlp.support.interrupt import end_if_interrupted
from ctr_nlp.support.tables import markdown, write_csv

Columns = dict[str, tuple[str, ...]]
"""Titles of columns, and the keys of a row that each shows."""
TABLES: dict[str, Columns] = {
    "errors": {
        "variant": ("variant",),
        "e3 mm": ("e3",),
        "e4 mm": ("e4",),
        "max mm": ("e_max",),
        "paper": ("seed_e3", "seed_e4"),
        "dominant": ("dominant_e3", "dominant_e4"),
        "elastic": ("elastic_e3", "elastic_e4"),
        "failed": ("failed",),
    },
    "motion and time": {
        "variant": ("variant",),
        "rad": ("step_alpha",),
        "mm": ("step_beta",),
        "tilt": ("step_theta",),
        "mm²/s": ("roughness",),
        "ms 50, 99 %": ("median_ms", "p99_ms"),
        "total s": ("total_s",),
        "paper s": ("seed_t_s",),
        "build s": ("build_s",),
    },
    "verdicts on the elastic model and over samples": {
        "variant": ("variant",),
        **{short: (f"verdict_{name}",) for name, short in SHORT_NAMES.items()},
        "tip mm": ("tip_last",),
        "lost": ("draws_lost",),
    },
}
"""The printed tables; each fits into 100 columns. errors: e3 and e4 of the paper and on each model; motion: the
largest steps of alpha (rad), beta (mm) and theta (tilt, rad) from frame to frame, roughness (mm²/s), and times."""
COMPARISON_PAGE_COLUMNS: Columns = {
    "variant": ("variant",),
    "e3 mm": ("e3",),
    "e4 mm": ("e4",),
    "max mm": ("e_max",),
    "paper e3, e4": ("seed_e3", "seed_e4"),
    "steps rad, mm, rad": ("step_alpha", "step_beta", "step_theta"),
    "roughness mm²/s": ("roughness",),
    "ms 50, 99 %": ("median_ms", "p99_ms"),
    "total s": ("total_s",),
    "paper s": ("seed_t_s",),
    "build s": ("build_s",),
    "failed": ("failed",),
    "on dominant e3, e4": ("dominant_e3", "dominant_e4"),
    "on elastic e3, e4": ("elastic_e3", "elastic_e4"),
    "over samples e3": ("draws_e3",),
    "lost": ("draws_lost",),
    "stability": ("stability_between",),
    "snaps": ("snaps",),
    "last tip mm": ("tip_last",),
    **{name.replace("_", " "): (f"verdict_{name}",) for name in Verdicts._fields},
}
"""Columns of the table in Markdown."""


UNCHECKED = "?"
"""Stands for NOT CHECKED in the printed tables, which have no room for the words."""
AGREEMENT = ("problem", "objective mm²", "difference mm²", "limits that differ", "agree", "s")
"""Columns of the table of agreements."""


def _cells(row: dict[str, Any], columns: Columns = COMPARISON_PAGE_COLUMNS) -> list[str]:
    """Return a row's cells; shares in percent, several numbers of a column divided by a stroke."""
    told = row | {"draws_lost": None if row["draws_lost"] is None else f"{100 * row['draws_lost']:.3g}%"}
    return [
        " / ".join(format_cell(told[key]) for key in keys if told[key] is not None) for keys in columns.values()
    ]


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Solve problems with every variant, one after the other, and print errors, steps and times "
        f"beside the paper's Table II; judge each plan on the elastic model and on {DEFAULT_PLAN_SAMPLES} "
        f"samples of "
        "the robot's tolerances. Write comparison.md, .csv and "
        ".json. Where a variant does not serve a problem, its row says why.",
        epilog="Exit status: 0 where no verdict on a plan of ours is `no`, 1 where one is, 2 where input is bad "
        "or no variant serves any problem, 130 after an interruption (what was done goes into "
        "DIR/interrupted, and DIR's own files stay).",
    )
    parser.add_argument(
        "problems", metavar="PROBLEM", nargs="*", help=f"{problems.PROBLEM_ARGUMENT_HELP} (default all names)"
    )
    parser.add_argument(
        "--variants",
        metavar="NAME",
        nargs="+",
        help=f"(default all that work here, of {', '.join(VARIANTS)}; by name only "
        f"{', '.join(VARIANTS_BY_NAME_ONLY)}: robust "
        "ones plan for the robot's tolerances and take seconds to a minute a problem, follow-the-leader needs a "
        "path that grows, and the exact one tubes that can follow it; rrt-connect leads through a lumen to the "
        "last frame, whatever lies between, and needs the extra `sampling`; s2j ones need networks that "
        "`python scripts/studies/learn.py` trains)",
    )
    parser.add_argument(
        "--all",
        action="store_true",
        help="every method once, ours and others' (or those of --variants), with the lumen's wall, which does not "
        "count otherwise; all motions judged on the elastic model and over draws, on one page a reader can go by: "
        "comparison.md",
    )
    options.add_out_option(parser, "runs/comparison")
    options.add_problem_options(parser)
    add_file_options(parser)
    options.add_compile_option(parser)
    options.add_settings(parser)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    settings = options.settings_from(arguments, *options.FRAME_SETTINGS)
    out = Path(arguments.out)
    names = arguments.variants or (every_method() if arguments.all else available_variants())
    variants = [parse_variant(name) for name in names]
    chosen = problems.load_all(arguments.problems or PROBLEM_NAMES, arguments)
    check_folder(out, "comparison")
    end_if_interrupted()
    # The paper's methods know neither walls nor an end that counts more than other frames.
    plain = replace(settings, contact_weight=0.0, arrival_weight=0.0)
    settings, measure = (settings, measure_plan) if arguments.all else (plain, None)
    with progress_bar() as labelled:
        found = compare(
            chosen, variants, settings, lambda problem, variant: labelled(f"{problem}, {variant}"), measure
        )
    rows = found.rows
    done = len(rows) + len(found.refusals)
    interrupted = done < len(chosen) * len(variants) or any(row["interrupted"] for row in rows)
    place = results_folder(out, interrupted)
    with output_folder(place, "comparison") as staging:
        _write(found, page(found, _command(arguments)) if arguments.all else _page(found), staging)
    if not arguments.all:
        _print(found)
    for refusal in found.refusals:
        console().print(f"{refusal.problem}, {refusal.variant}: {refusal.why}")
    report_written_files(place, ("comparison.md", "comparison.csv", "comparison.json"))
    if interrupted:
        return EXIT_INTERRUPTED
    return (
        EXIT_SOME_FAILED
        if any(row["no"] for row in rows if row["variant"] not in REFERENCE_METHODS)
        else EXIT_SOLVED
    )


def _command(arguments: argparse.Namespace) -> str:
    """Return the command that makes the page again, with files by their names alone."""
    words = ["python scripts/studies/compare.py", *(Path(name).name for name in arguments.problems), "--all"]
    words += ["--variants", *arguments.variants] if arguments.variants else []
    words += [f"--frames {arguments.frames}"] if arguments.frames != 100 else []
    return " ".join(words + ([f"--trim {arguments.trim}"] if arguments.trim else []))


def _print(found: Comparison) -> None:
    for name in dict.fromkeys(row["problem"] for row in found.rows):
        rows = [row for row in found.rows if row["problem"] == name]
        for title, columns in TABLES.items():
            cells = [[_short(cell) for cell in _cells(row, columns)] for row in rows]
            print_table(f"{name}: {title}", list(columns), cells, styles=STYLES | {UNCHECKED: STYLES[NOT_CHECKED]})
    if found.agreements:
        print_table("do solvers of the horizon agree?", list(AGREEMENT), _agreements(found))


def _short(cell: str) -> str:
    """Return a cell of the printed tables: a verdict that was not checked is a question mark there."""
    return UNCHECKED if cell == NOT_CHECKED else cell


def _agreements(found: Comparison) -> list[list[str]]:
    cells = []
    for row in found.agreements:
        better = row["first" if row["first_objective"] < row["second_objective"] else "second"]
        objectives = f"{row['first']} {row['first_objective']:.6f}, {row['second']} {row['second_objective']:.6f}"
        agree = "yes" if row["agree"] else f"no: {better} is better"
        seconds = f"{row['first_s']:.2f} / {row['second_s']:.2f}"
        numbers = f"{row['difference']:.1e}", str(row["differing_limits"])
        cells.append([row["problem"], objectives, *numbers, agree, seconds])
    return cells


def _write(found: Comparison, text: str, folder: Path) -> None:
    refusals = [refusal._asdict() for refusal in found.refusals]
    for name, entries in (("comparison", found.rows), ("refusals", refusals), ("agreement", found.agreements)):
        if entries:
            told = json.dumps(entries, indent=1, allow_nan=False)
            (folder / f"{name}.json").write_text(told + "\n", encoding="utf-8")
    write_csv(folder / "comparison.csv", found.rows)
    (folder / "comparison.md").write_text(text, encoding="utf-8")


def _page(found: Comparison) -> str:
    rows = found.rows
    details = markdown(["problem", *COMPARISON_PAGE_COLUMNS], [[row["problem"], *_cells(row)] for row in rows])
    known = [model for model in KINEMATIC_MODELS if any(row.get(f"{model}_no") is not None for row in rows)]
    halves = [f"e3 in mm on the {model} model:\n\n{_overview(rows, model)}\n" for model in known]
    text = f"{''.join(halves)}{_samples_section(rows)}Everything:\n\n{details}"
    if found.agreements:
        text += f"\nWhether solvers of the horizon agree:\n\n{markdown(list(AGREEMENT), _agreements(found))}"
    return text


def _samples_section(rows: list[dict[str, Any]]) -> str:
    """Return a table of errors and losses over samples, a row a problem, a column an elastic variant; empty
    without any.
    """
    tried = [row for row in rows if row["draws"]]
    if not tried:
        return ""
    variants = list(dict.fromkeys(row["variant"] for row in tried))
    body = []
    for problem in dict.fromkeys(row["problem"] for row in tried):
        found = {row["variant"]: row for row in tried if row["problem"] == problem}
        cells = [
            f"{format_cell(found[v]['draws_e3'])}, {found[v]['draws_lost']:.1%}" if v in found else ""
            for v in variants
        ]
        body.append([problem, *cells])
    table = markdown(["problem", *(f"`{variant}`" for variant in variants)], body)
    return f"Mean e3 in mm over {tried[0]['draws']} draws of the tolerances, and the share lost:\n\n{table}\n"


def _overview(rows: list[dict[str, Any]], model: str) -> str:
    """Return a table of e3 in mm on a model, a row a problem, a column a variant; the paper's figures last.

    An exclamation mark: the verdict on stability is no; a star: another one is.
    """
    figures = (
        (TABLE_II_PAPER_METHOD_ELASTIC, TABLE_II_BASELINE_ELASTIC)
        if model_named(model).can_snap
        else (TABLE_II_PAPER_METHOD, TABLE_II_BASELINE)
    )
    variants = list(dict.fromkeys(row["variant"] for row in rows))
    header = [
        "problem",
        *(f"`{variant}`" for variant in variants),
        "the paper, published",
        "its baseline, published",
    ]
    body = []
    for problem in dict.fromkeys(row["problem"] for row in rows):
        found = {row["variant"]: row for row in rows if row["problem"] == problem}
        cells = [_cell(found[v], model) if v in found else "" for v in variants]
        published = (format_cell(each[problem][0]) if problem in each else "" for each in figures)
        body.append([problem, *cells, *published])
    return markdown(header, body)


def _cell(row: dict[str, Any], model: str) -> str:
    no = set(filter(None, row[f"{model}_no"].split(", ")))
    return format_cell(row[f"{model}_e3"]) + "*" * bool(no - {"stable"}) + "!" * ("stable" in no)


main = Command("compare.py", _parser, _run)

if __name__ == "__main__":
    sys.exit(main())
