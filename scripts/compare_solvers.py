"""See ctr_nlp/cli/commands/compare_solvers.py, or run with --help."""

import signal
import sys
from pathlib import Path

if __name__ == "__main__":
    if hasattr(signal, "pthread_sigmask"):  # Ctrl-C waits until the program can answer it
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})

    from ctr_nlp.cli.commands.compare_solvers import main

    sys.exit(main(Path(__file__).resolve().parents[1] / "problems"))
