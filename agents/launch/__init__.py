"""Processes: the ranks of a run, their GPUs, signals, and how they end."""
