"""Measures what docs/lab/benchmarks.md and docs/lab/benchmark-table.md say.

    python scripts/benchmarks/benchmark.py step kernels --json docs/lab/benchmarks.jsonl
    python scripts/benchmarks/benchmark.py report

The first prints a table and appends a line per measurement to a file of JSON lines; the second
turns docs/lab/benchmarks.jsonl into docs/lab/benchmark-table.md and its plots. A measurement is the
median of its samples, its spread their 10th and 90th percentiles. A sample is the mean of as many
calls as fill 50 ms after warming up, timed by CUDA events on a GPU and by the clock on the CPU.
"""

import argparse
import difflib
import inspect
import json
import os
import re
import subprocess
import sys
from datetime import date
from pathlib import Path

# Before torch is imported, which would have idle threads spin.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import torch

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "scripts" / "benchmarks")]

import benchmark_report  # noqa: E402
from trainings import COMPARED  # noqa: E402
from workloads import BENCHMARKS  # noqa: E402

from megastep import engine  # noqa: E402


def output_of(*words):
    """What a command prints, or nothing if it is not there or fails."""
    try:
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
        return "" if done.returncode else done.stdout.strip()
    except OSError:
        return ""


def commit():
    """The commit that is measured, marked if the tree, docs apart, differs from it."""
    return (output_of("git", "rev-parse", "--short", "HEAD") or "unknown") + (
        "+" if output_of("git", "status", "--porcelain", "-uno", "--", ".", ":!docs") else ""
    )


def machine(device):
    """What a record says of where it was measured."""
    if device.type == "cuda":
        driver = output_of(
            "nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"
        ).partition("\n")[0]
        on, cuda = torch.cuda.get_device_name(device), torch.version.cuda
    else:
        info = Path("/proc/cpuinfo")
        names = re.findall(r"model name\s*: (.*)", info.read_text() if info.exists() else "") or [
            "unknown"
        ]
        on, driver, cuda = (
            f"CPU, {torch.get_num_threads()} threads of {names[0].strip()}",
            None,
            None,
        )
    return dict(
        on=on, driver="unknown" if driver == "" else driver, torch=torch.__version__, cuda=cuda
    )


def measure(name, device, commit, options=None):
    """The records of a benchmark, as they come; `options` are arguments of it."""
    device = torch.device("cpu") if name == "cpu" else device
    words = ["python scripts/benchmarks/benchmark.py", name]
    for key, value in (options or {}).items():
        words += [f"--{key}", *map(str, value if isinstance(value, list) else [value])]
    words += ["--device cpu"] * (device.type == "cpu")
    where = machine(device)
    for found in BENCHMARKS[name](device, **options or {}):
        numbers = {key: rounded(found[key]) for key in ("value", "lower", "upper")}
        yield dict(
            benchmark=name,
            **{**found, **numbers},
            **where,
            commit=commit,
            date=str(date.today()),
            command=" ".join(words),
        )


def rounded(number):
    return None if number is None else float(f"{number:.6g}")


def checked(options):
    """The device to measure on. ValueError or EngineError, one sentence, for what cannot be
    measured.
    """
    for name in options.benchmarks:
        if name not in BENCHMARKS:
            near = difflib.get_close_matches(name, [*BENCHMARKS, "report"], 1, 0)[0]
            raise ValueError(
                f"there is no benchmark {name!r}; did you mean {near!r}? There are "
                f"{', '.join(BENCHMARKS)}, and report, which stands alone."
            )
    device = engine.device(options.device)
    if device.type == "cuda":
        torch.cuda.set_device(device)
    return device


def main(argv=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "benchmarks",
        nargs="+",
        metavar="BENCHMARK",
        help=f"{', '.join(BENCHMARKS)}, or report alone",
    )
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:1")
    parser.add_argument(
        "--seeds", nargs="+", type=int, metavar="SEED", help="of train, duels and learners"
    )
    parser.add_argument(
        "--budgets", nargs="+", type=int, metavar="SECONDS", help="of train and learners"
    )
    parser.add_argument("--worlds", nargs="+", choices=COMPARED, help="of learners")
    parser.add_argument(
        "--samples", type=int, metavar="N", help="that each run of duels and ablation learns from"
    )
    parser.add_argument("--commit", help="what is measured, where git cannot tell")
    parser.add_argument(
        "--json", type=Path, help="a file to append records to; report reads docs/lab/*.jsonl"
    )
    try:
        run(parser.parse_args(argv))
    except (ValueError, OSError, engine.EngineError) as error:
        print(f"benchmark.py: {error}", file=sys.stderr)
        return 2
    return 0


def run(options):
    if options.benchmarks == ["report"]:
        return benchmark_report.report(options.json or ROOT / "docs" / "lab" / "benchmarks.jsonl")
    device, measured = checked(options), options.commit or commit()
    print(benchmark_report.HEADER, flush=True)
    for name in options.benchmarks:
        taken = inspect.signature(BENCHMARKS[name]).parameters
        only = {k: v for k, v in vars(options).items() if k in taken and k != "device" and v}
        for record in measure(name, device, measured, only):
            print(benchmark_report.row(record), flush=True)
            if options.json:
                with options.json.open("a") as file:
                    print(json.dumps(record), file=file)


if __name__ == "__main__":
    sys.exit(main())
