"""See ctr_nlp/cli/commands/list_branches.py, or run with --help."""

import signal
import sys

if __name__ == "__main__":
    if hasattr(signal, "pthread_sigmask"):  # Ctrl-C waits until the program can answer it
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})

    from ctr_nlp.cli.commands.list_branches import main

    sys.exit(main())
