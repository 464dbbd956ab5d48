"""Faults that tests inject: full disks, missing packages."""

import contextlib
import resource
import sys


@contextlib.contextmanager
def full_disk(n_bytes=0):
    """Writing a file beyond `n_bytes` raises OSError, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def not_installed(monkeypatch, *modules):
    """Makes importing `modules` fail, as if their package were absent. Modules that are already
    imported keep working.
    """
    for name in modules:
        monkeypatch.setitem(sys.modules, name, None)
