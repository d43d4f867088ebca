"""What a study costs beside its plans: against a plain pool of processes, and as a million plans on 256 workers.

python scripts/studies/study_scale.py [--parts pool scale] [--rows DIR | --seconds S] [--plans N] [--workers N]
    [--simulated N] [--dominant N] [--robust N] [--pairs N]
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from study_costs.pool_comparison import compare_with_pool, rows_of
from study_costs.scale import measure_study_cost, project_study, simulate_study

from ctr_nlp.studies.grid.results import Results
from ctr_nlp.studies.grid.study_file import Study
from ctr_nlp.support.tables import markdown

ROBUST_FRAMES = 4
"""Of robust plans in the comparison with a pool."""


def main() -> None:
    """Measure, project, simulate, and print tables."""
    parser = argparse.ArgumentParser(description="What studies cost beside their plans.")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="(default all)")
    parser.add_argument("--rows", metavar="DIR", type=Path, help="folder of a study whose plans last as long")
    parser.add_argument("--seconds", metavar="S", type=float, default=0.114, help="of a plan (default 0.114)")
    parser.add_argument("--plans", metavar="N", type=int, default=1_000_000, help="(default 1,000,000)")
    parser.add_argument("--workers", metavar="N", type=int, default=256, help="(default 256)")
    parser.add_argument(
        "--simulated", metavar="N", type=int, default=150_000, help="plans of the simulation (default 150,000)"
    )
    parser.add_argument("--dominant", metavar="N", type=int, default=400, help="plans beside a pool (default 400)")
    parser.add_argument("--robust", metavar="N", type=int, default=40, help="plans beside a pool (default 40)")
    parser.add_argument("--pairs", metavar="N", type=int, default=1, help="of a study and a pool (default 1)")
    asked = parser.parse_args()
    for part in asked.parts:
        PARTS[part](asked)


def pool(asked: argparse.Namespace) -> None:
    """Compare studies with a pool of two processes in processor time, page faults and memory."""
    kinds: dict[str, dict[str, Any]] = {
        "dominant": {"models": "dominant", "frames": 100},
        "robust": {"methods": "robust-horizon", "frames": ROBUST_FRAMES},
    }
    for name, kind in kinds.items():
        count = getattr(asked, name)
        if not count:
            continue
        told = {"problems": {"names": ["arc"]}, "settings": {"seed": list(range(count))}} | kind
        study = Study.from_dict(told, Path())
        study.cases[0].row()  # compiles what all of them are solved with
        found = compare_with_pool(study, 2, asked.pairs)
        columns = (f"{count} {name} plans", "user s", "system s", "page faults", "MB of a worker")
        print(markdown(columns, rows_of(found)))
        print(f"The study takes {found.ratio:.3f} times the processor time of the pool.\n")


def scale(asked: argparse.Namespace) -> None:
    """Measure what a batch costs, and project and simulate large studies from it."""
    lasted = np.array([asked.seconds])
    if asked.rows is not None:
        lasted = Results(asked.rows).frame()["process_s"].dropna().to_numpy()
    drawn = np.random.default_rng(0).choice(lasted, asked.simulated).tolist()
    cost = measure_study_cost()
    print(markdown(("cost", "s or bytes"), [[name, f"{value:.3g}"] for name, value in asdict(cost).items()]))
    columns = {
        f"{asked.plans} plans, projected": project_study(asked.plans, asked.workers, float(lasted.mean()), cost),
        f"{asked.simulated} plans, projected": project_study(asked.simulated, asked.workers, np.mean(drawn), cost),
        "simulated": simulate_study(drawn, asked.workers),
    }
    each = [asdict(column) for column in columns.values()]
    rows = [[name, *(f"{column[name]:.4g}" for column in each)] for name in each[0]]
    print(markdown(("quantity", *columns), rows))


PARTS = {"pool": pool, "scale": scale}
"""What is measured."""


if __name__ == "__main__":
    main()
