"""The files of a run: folder and lock, checkpoints, metrics, provenance, and exported agents."""
