"""`python -m megastep` is the command `megastep`."""

import sys

from megastep.agents.cli.entry import main

if __name__ == "__main__":
    sys.exit(main())
