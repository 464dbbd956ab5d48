"""Faults that tests inject for real: disks that are full, packages that are not installed."""

import contextlib
import resource
import sys


@contextlib.contextmanager
def full_disk(n_bytes=0):
    """No file of this process may grow beyond `n_bytes`: writing raises OSError, as on a disk that
    is full.
    """
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def not_installed(monkeypatch, *modules):
    """Importing any of `modules` fails, as it does where their package is absent. What is imported
    already stays whole: only its name is hidden.
    """
    for name in modules:
        monkeypatch.setitem(sys.modules, name, None)
