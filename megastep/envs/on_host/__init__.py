"""What environments of other packages share, which step on the host."""
