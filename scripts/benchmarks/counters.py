"""A benchmark of benchmark.py: what NVIDIA's Nsight Compute (`ncu`) counts of each kernel."""

import csv
import shutil
import subprocess
import sys
from pathlib import Path

import timing

N_AGENTS = 65_536
METRICS = {  # of ncu: what they are called here, in what unit
    "gpu__time_duration.sum": ("time", "ns per agent"),
    "smsp__inst_executed.sum": ("warp instructions", "per agent"),
    "smsp__issue_active.avg.pct_of_peak_sustained_active": ("issue slots used", "%"),
    "sm__warps_active.avg.pct_of_peak_sustained_active": ("achieved occupancy", "%"),
    "l1tex__throughput.avg.pct_of_peak_sustained_active": ("L1 throughput", "%"),
    "lts__throughput.avg.pct_of_peak_sustained_elapsed": ("L2 throughput", "%"),
    "dram__throughput.avg.pct_of_peak_sustained_elapsed": ("DRAM throughput", "%"),
}
KERNELS = (  # in the order in which workloads.operations launches them
    ("physics", "`physics`"),
    ("spawn", "`spawn` of 1 in 256"),
    ("uniform", "`uniform` of 1 in 256"),
    ("render", "`observe` as Explorer does"),
    ("update_agent_geometry", "`update_agent_geometry` in `render`"),
    ("render", "`render` kernel"),
    ("render", "`observe` as Minimal does"),
    ("update_agent_geometry", "`update_agent_geometry`, lit, 4 per home"),
)
PROFILED = """
import sys; sys.path.insert(0, {scripts!r})
import torch, workloads
for _, function in workloads.operations({n}, torch.device({device!r})):
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
    yield from measurements(done.stdout)


def measurements(output: str):
    """The measurements in what ncu prints. ValueError if other kernels than KERNELS are in it."""
    lines = output.splitlines()
    start = next((i for i, line in enumerate(lines) if line.startswith('"ID"')), len(lines))
    names = {name for name, _ in KERNELS}
    rows = [row for row in csv.DictReader(lines[start:]) if row["Kernel Name"] in names]
    if [row["Kernel Name"] for row in rows] != [name for name, _ in KERNELS]:
        raise ValueError(
            f"ncu did not count the kernels it was given; it said: "
            f"{' '.join(output.split())[-300:]}"
        )
    for (_, what), row in zip(KERNELS, rows):
        for metric, (name, unit) in METRICS.items():
            count = N_AGENTS if unit.endswith("per agent") else 1
            value = float(row[metric].replace(",", "")) / count
            yield timing.measurement(f"{what}: {name}", unit, [value])
