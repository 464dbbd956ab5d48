"""Films a trained policy: python record.py --help."""

import sys

from agents.cli.record import main

if __name__ == "__main__":
    sys.exit(main())
