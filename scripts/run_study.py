"""`ctr-nlp study` from a clone of this repository: --help tells the options."""

import sys

from ctr_nlp.cli.main import COMMANDS, script

if __name__ == "__main__":
    sys.exit(script(COMMANDS["study"]))
