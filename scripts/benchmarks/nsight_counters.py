"""The benchmark `counters`: hardware counters of each kernel, read by NVIDIA's Nsight Compute."""

import csv
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import timing
import torch

N_AGENTS = 65_536
METRICS = {  # ncu's name: (name in the records, unit)
    "gpu__time_duration.sum": ("time", "ns per agent"),
    "smsp__inst_executed.sum": ("warp instructions", "per agent"),
    "smsp__issue_active.avg.pct_of_peak_sustained_active": ("issue slots used", "%"),
    "sm__warps_active.avg.pct_of_peak_sustained_active": ("achieved occupancy", "%"),
    "l1tex__throughput.avg.pct_of_peak_sustained_active": ("L1 throughput", "%"),
    "lts__throughput.avg.pct_of_peak_sustained_elapsed": ("L2 throughput", "%"),
    "dram__throughput.avg.pct_of_peak_sustained_elapsed": ("DRAM throughput", "%"),
}
#: (kernel, operation), in the order in which engine_operations.operations launches them.
# with N_AGENTS agents; fewer have others, see `_kernel` in megastep/engine/rendering.py
KERNELS = (
    ("physics", "`physics`"),
    ("spawn", "`spawn` of 1 in 256"),
    ("uniform", "`uniform` of 1 in 256"),
    ("render", "`observe` as Explorer does"),
    ("update_agent_geometry", "`update_agent_geometry` in `render`"),
    ("render", "`render` kernel"),
    ("render", "`observe` as Minimal does"),
    ("update_agent_geometry", "`update_agent_geometry`, lit, 4 per home"),
)
PROFILED_CODE = """
import sys; sys.path[:0] = [{root!r}, {scripts!r}]
import torch, engine_operations
for _, operation in engine_operations.operations({n}, torch.device({device!r})):
    operation(0)
    torch.cuda.synchronize()
    torch.cuda.profiler.start()
    operation(1)
    torch.cuda.synchronize()
    torch.cuda.profiler.stop()
"""
NCU_OPTIONS = (
    *("--clock-control", "none"),
    *("--profile-from-start", "off"),
    *("--csv", "--page", "raw", "--print-units", "base"),
    *("--metrics", ",".join(METRICS)),
)


def counters(device: torch.device) -> Iterator[dict]:
    """Counters of each kernel for 65,536 agents, from Nsight Compute: instructions, use of issue
    slots and of memory. Needs `ncu` and permission to read the counters. Profiling slows kernels,
    so the times differ from those of `kernels`.
    """
    ncu = shutil.which("ncu")
    if ncu is None or device.type != "cuda":
        raise ValueError("counters needs a GPU, and NVIDIA's ncu (Nsight Compute) on the PATH.")
    scripts = Path(__file__).parent
    code = PROFILED_CODE.format(
        root=str(scripts.parents[1]), scripts=str(scripts), n=N_AGENTS, device=str(device)
    )
    command = [ncu, *NCU_OPTIONS, sys.executable, "-c", code]
    yield from measurements(subprocess.run(command, capture_output=True, text=True).stdout)


def measurements(output: str) -> Iterator[dict]:
    """Yields the measurements in ncu's output. ValueError if its kernels are not KERNELS."""
    lines = output.splitlines()
    start = next((i for i, line in enumerate(lines) if line.startswith('"ID"')), len(lines))
    names = {name for name, _ in KERNELS}
    rows = [row for row in csv.DictReader(lines[start:]) if row["Kernel Name"] in names]
    if [row["Kernel Name"] for row in rows] != [name for name, _ in KERNELS]:
        raise ValueError(
            f"ncu did not count the expected kernels. The end of its output: "
            f"{' '.join(output.split())[-300:]}"
        )
    for (_, operation), row in zip(KERNELS, rows):
        for metric, (name, unit) in METRICS.items():
            count = N_AGENTS if unit.endswith("per agent") else 1
            value = float(row[metric].replace(",", "")) / count
            yield timing.measurement(f"{operation}: {name}", unit, [value])
