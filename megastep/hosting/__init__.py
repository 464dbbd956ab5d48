"""Environments of other packages, N of them as one environment of ours, stepped on the host."""
