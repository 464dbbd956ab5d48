"""A stand-in for loky's pool of processes, each of which takes seconds to import torch."""

from concurrent.futures import Future


class InThisProcess:
    """Calls functions when they are submitted."""

    def __init__(self, n_workers, **options):
        pass

    def submit(self, function, *arguments):
        future = Future()
        try:
            future.set_result(function(*arguments))
        except Exception as error:
            future.set_exception(error)
        return future

    def map(self, function, items, chunksize):
        return map(function, items)

    def shutdown(self, wait, kill_workers=False):
        pass
