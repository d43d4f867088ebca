"""See ctr_nlp/cli/compare_solvers.py, or run with --help."""

import sys
from pathlib import Path

from ctr_nlp.cli.compare_solvers import main

if __name__ == "__main__":
    sys.exit(main(Path(__file__).resolve().parents[1] / "problems"))
