"""Code that must not wait for the GPU."""

import contextlib

import torch


@contextlib.contextmanager
def no_synchronisation():
    """Raises where the host waits for the GPU."""
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")
