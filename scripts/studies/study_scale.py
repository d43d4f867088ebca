"""How a study of a million plans would fare on 256 workers, and a simulated one that says whether that is so.

python scripts/studies/study_scale.py [--rows DIR | --seconds S] [--plans N] [--workers N] [--simulated N]
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

import numpy as np

from ctr_nlp.studies.grid.results import Results
from ctr_nlp.studies.workers.scale import measured, projected, simulated
from ctr_nlp.support.tables import markdown


def main() -> None:
    """Measure, project, simulate, and print two tables."""
    parser = argparse.ArgumentParser(description="What studies cost beside their plans.")
    parser.add_argument("--rows", metavar="DIR", type=Path, help="folder of a study whose plans last as long")
    parser.add_argument("--seconds", metavar="S", type=float, default=0.114, help="of a plan (default 0.114)")
    parser.add_argument("--plans", metavar="N", type=int, default=1_000_000, help="(default 1,000,000)")
    parser.add_argument("--workers", metavar="N", type=int, default=256, help="(default 256)")
    parser.add_argument(
        "--simulated", metavar="N", type=int, default=150_000, help="plans of the simulation (default 150,000)"
    )
    asked = parser.parse_args()
    lasted = np.array([asked.seconds])
    if asked.rows is not None:
        lasted = Results(asked.rows).frame()["process_s"].dropna().to_numpy()
    drawn = np.random.default_rng(0).choice(lasted, asked.simulated).tolist()
    cost = measured()
    print(markdown(("cost", "s or bytes"), [[name, f"{value:.3g}"] for name, value in asdict(cost).items()]))
    columns = {
        f"{asked.plans} plans, projected": projected(asked.plans, asked.workers, float(lasted.mean()), cost),
        f"{asked.simulated} plans, projected": projected(asked.simulated, asked.workers, np.mean(drawn), cost),
        "simulated": simulated(drawn, asked.workers),
    }
    each = [asdict(column) for column in columns.values()]
    rows = [[name, *(f"{column[name]:.4g}" for column in each)] for name in each[0]]
    print(markdown(("quantity", *columns), rows))


if __name__ == "__main__":
    main()
