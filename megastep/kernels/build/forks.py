"""Forks of a process whose OpenMP threads are running.

A fork copies only the thread that calls it. GNU OpenMP does not notice: the first parallel loop of
the child waits forever for threads that it does not have.
"""

import ctypes
import os

import torch

__all__ = ["end_threads_at_forks"]

SOFT = 1  # omp_pause_soft: settings such as the number of threads stay


def end_threads_at_forks(library: ctypes.CDLL) -> None:
    """Has the OpenMP runtime of a library end its threads before each ``os.fork``. Parent and child
    start new ones when they next need them, so both compute as before, with the same bits.

    Does nothing if the library uses no OpenMP.
    """
    try:
        pause = library.omp_pause_resource_all
    except AttributeError:
        return
    os.register_at_fork(before=lambda: pause(SOFT))


end_threads_at_forks(ctypes.CDLL(torch._C.__file__))  # PyTorch's, which kernels mostly share
