"""Measures a trained policy: python evaluate.py --help."""

import sys

from megastep.agents.cli.entry import run_command

if __name__ == "__main__":
    sys.exit(run_command("evaluate"))
