"""Fixtures of the tests of the command line."""

from concurrent.futures import Future

import loky
import pytest


class InThisProcess:
    """Stands for loky's pool of processes, each of which takes seconds to import torch."""

    def __init__(self, n_workers, env):
        pass

    def submit(self, function, *arguments):
        future = Future()
        try:
            future.set_result(function(*arguments))
        except Exception as error:
            future.set_exception(error)
        return future

    def shutdown(self, wait, kill_workers):
        pass


@pytest.fixture(autouse=True)
def drawn_in_this_process(monkeypatch):
    """Has frames of videos drawn here. tests/test_recording.py has the real pool, and so do the
    scripts in their own processes.
    """
    monkeypatch.setattr(loky, "ProcessPoolExecutor", InThisProcess)
