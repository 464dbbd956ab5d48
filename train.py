"""Trains a policy: python train.py --help."""

import sys

from agents.cli.train import main

if __name__ == "__main__":
    sys.exit(main())
