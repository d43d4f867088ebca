"""See ctr_nlp/cli/solve_per_frame.py, or run with --help."""

import sys
from pathlib import Path

from ctr_nlp.cli.solve_per_frame import main

if __name__ == "__main__":
    sys.exit(main(Path(__file__).resolve().parents[1] / "problems"))
