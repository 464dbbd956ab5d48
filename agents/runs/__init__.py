"""What a run leaves on disk: its folder and lock, checkpoints, records, and agents in one file."""
