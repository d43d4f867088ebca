"""`ctr-nlp plan` over a horizon, from a clone of this repository: --help tells the options."""

import sys

from ctr_nlp.cli.main import HORIZON_ENTRY, script

if __name__ == "__main__":
    sys.exit(script(HORIZON_ENTRY))
