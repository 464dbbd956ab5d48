"""The processes of a run: its ranks, their GPUs, signals and exit codes."""
