"""Times all-reduces between processes that torchrun started: a line per size, with the number of
float32 and the microseconds of each lap.

    torchrun --nproc-per-node=2 scripts/benchmarks/all_reduce.py cuda
"""

import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # this checkout comes first

import torch
from torch import distributed

from megastep.agents.distributed import process_group

#: A few statistics, and the gradients of Explorer's default network.
SIZES = 8, 729_888
N_LAPS, N_CALLS = 7, 100


def main(kind: str) -> None:
    info = process_group.rank_info()
    device = torch.device(kind, info.local_rank) if kind == "cuda" else torch.device(kind)
    if kind == "cuda":
        torch.cuda.set_device(device)
    process_group.start()
    for size in SIZES:
        numbers = torch.zeros(size, device=device)
        laps = []
        for _ in range(1 + N_LAPS):  # connections are made in the first
            process_group.exchange([0.0])
            start = time.perf_counter()
            for _ in range(N_CALLS):
                distributed.all_reduce(numbers)
            if kind == "cuda":
                torch.cuda.synchronize()
            laps.append(1e6 * (time.perf_counter() - start) / N_CALLS)
        if info.rank == 0:
            print(size, *(f"{lap:.2f}" for lap in laps[1:]), flush=True)
    process_group.stop()


if __name__ == "__main__":
    main(sys.argv[1])
