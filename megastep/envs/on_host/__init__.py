"""Shared by the environments of other packages, which step on the host."""
