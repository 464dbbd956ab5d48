"""Measures a trained policy: python evaluate.py --help."""

import sys

from agents.cli.evaluate import main

if __name__ == "__main__":
    sys.exit(main())
