"""A work of benchmark.py: what NVIDIA's Nsight Compute (`ncu`) counts of each kernel."""

import csv
import shutil
import subprocess
import sys
from pathlib import Path

N_AGENTS = 65_536
METRICS = {  # of ncu: what they are called here, in what unit
    "gpu__time_duration.sum": ("time", "ns an agent"),
    "smsp__inst_executed.sum": ("warp instructions", "an agent"),
    "smsp__issue_active.avg.pct_of_peak_sustained_active": ("issue slots used", "%"),
    "sm__warps_active.avg.pct_of_peak_sustained_active": ("achieved occupancy", "%"),
    "l1tex__throughput.avg.pct_of_peak_sustained_active": ("L1 throughput", "%"),
    "lts__throughput.avg.pct_of_peak_sustained_elapsed": ("L2 throughput", "%"),
    "dram__throughput.avg.pct_of_peak_sustained_elapsed": ("DRAM throughput", "%"),
}
KERNELS = (  # that the operations of benchmark.py launch, in order
    ("physics", "`physics`"),
    ("spawn", "`spawn` of 1 in 256"),
    ("draw", "`draw` of 1 in 256"),
    ("sight", "`observe` as Explorer does"),
    ("place", "`place` in `render`"),
    ("sight", "`sight` in `render`"),
    ("sight", "`observe` as Minimal does"),
    ("place", "`place`, lit, 4 a home"),
)
PROFILED = """
import sys; sys.path.insert(0, {scripts!r})
import torch, benchmark
for _, function in benchmark.operations({n}, torch.device({device!r})):
    function(0)
    torch.cuda.synchronize()
    torch.cuda.profiler.start()
    function(1)
    torch.cuda.synchronize()
    torch.cuda.profiler.stop()
"""


def counters(device):
    """What Nsight Compute counts of each kernel, 65,536 agents: instructions, use of issue slots
    and of memory. Needs `ncu` and leave to read the counters; it slows kernels, so the times are
    not those of `kernels`.
    """
    program = shutil.which("ncu")
    if program is None or device.type != "cuda":
        raise ValueError("counters needs a GPU, and NVIDIA's ncu (Nsight Compute) on the PATH.")
    child = PROFILED.format(scripts=str(Path(__file__).parent), n=N_AGENTS, device=str(device))
    done = subprocess.run(
        [
            program,
            "--clock-control",
            "none",
            "--profile-from-start",
            "off",
            "--csv",
            "--page",
            "raw",
            "--print-units",
            "base",
            "--metrics",
            ",".join(METRICS),
            sys.executable,
            "-c",
            child,
        ],
        capture_output=True,
        text=True,
    )
    yield from figures(done.stdout)


def figures(said):
    """The figures in what ncu prints. ValueError if other kernels than KERNELS are in it."""
    lines = said.splitlines()
    start = next((i for i, line in enumerate(lines) if line.startswith('"ID"')), len(lines))
    names = {name for name, _ in KERNELS}
    rows = [row for row in csv.DictReader(lines[start:]) if row["Kernel Name"] in names]
    if [row["Kernel Name"] for row in rows] != [name for name, _ in KERNELS]:
        raise ValueError(
            f"ncu did not count what was asked for; it said: {' '.join(said.split())[-300:]}"
        )
    for (_, what), row in zip(KERNELS, rows):
        for metric, (name, unit) in METRICS.items():
            value = float(row[metric].replace(",", "")) / (
                N_AGENTS if unit.endswith("an agent") else 1
            )
            yield dict(what=f"{what}: {name}", value=value, unit=unit, low=None, high=None, n=1)
