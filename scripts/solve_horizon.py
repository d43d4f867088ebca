"""See ctr_nlp/cli/solve_horizon.py, or run with --help."""

import sys
from pathlib import Path

from ctr_nlp.cli.solve_horizon import main

if __name__ == "__main__":
    sys.exit(main(Path(__file__).resolve().parents[1] / "problems"))
