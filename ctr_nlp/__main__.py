"""`python -m ctr_nlp` is the command `ctr-nlp`."""

import sys

from ctr_nlp.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
