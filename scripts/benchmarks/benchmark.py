"""Measures the numbers in docs/lab/benchmarks.md.

    python scripts/benchmarks/benchmark.py step kernels --json docs/lab/benchmarks.jsonl
    python scripts/benchmarks/benchmark.py report

The first prints a table and appends a line per measurement to a file of JSON lines. The second
draws the figures of docs/lab from these records. The site has a table of all of them.

A measurement is the median of its samples, with their 10th and 90th percentiles as its spread. A
sample is the mean over as many calls as fill 50 ms, after a warm-up, timed by CUDA events on a GPU
and by the clock on the CPU.
"""

import argparse
import difflib
import inspect
import json
import os
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # idle threads of PyTorch must not spin
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # this checkout comes first

import records
import report
import torch
from catalogue import BENCHMARKS

from megastep import engine


def measure(
    name: str, device: torch.device, commit: str, options: dict | None = None
) -> Iterator[dict]:
    """Runs a benchmark and yields its records; ``options`` are arguments of the benchmark."""
    options = options or {}
    device = torch.device("cpu") if name == "cpu" else device
    provenance = records.provenance(device, commit)
    command = command_line(name, device, options)
    for measurement in BENCHMARKS[name](device, **options):
        numbers = {key: rounded(measurement[key]) for key in ("value", "lower", "upper")}
        yield dict(benchmark=name) | measurement | numbers | provenance | dict(command=command)


def command_line(name: str, device: torch.device, options: dict) -> str:
    """Returns the command that repeats a benchmark."""
    words = ["python scripts/benchmarks/benchmark.py", name]
    for key, value in options.items():
        values = value if isinstance(value, list) else [value]
        words += [f"--{key}", *(shlex.quote(str(value)) for value in values)]
    words += ["--device cpu"] * (device.type == "cpu")
    return " ".join(words)


def rounded(number: float | None) -> float | None:
    return None if number is None else float(f"{number:.6g}")


def check_names(names: list[str]) -> None:
    """Raises ValueError for an unknown benchmark."""
    for name in names:
        if name not in BENCHMARKS:
            closest = difflib.get_close_matches(name, [*BENCHMARKS, "report"], 1, 0)[0]
            raise ValueError(
                f"unknown benchmark {name!r}. Did you mean {closest!r}? Available: "
                f"{', '.join(BENCHMARKS)}; or report alone."
            )


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "benchmarks",
        nargs="+",
        metavar="BENCHMARK",
        help=f"{', '.join(BENCHMARKS)}; or report alone",
    )
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:1")
    parser.add_argument("--seeds", nargs="+", type=int, help="for train and ranks")
    parser.add_argument("--budgets", nargs="+", type=int, help="seconds, for train and ranks")
    parser.add_argument("--envs", nargs="+", metavar="ENV", help="for scaling; or experiment=NAME")
    parser.add_argument("--seconds", type=int, metavar="S", help="of a run, for members")
    parser.add_argument("--commit", help="the commit to record, if git is not available")
    parser.add_argument(
        "--json",
        type=Path,
        metavar="FILE",
        help="append records to this file; report reads docs/lab/benchmarks.jsonl by default",
    )
    try:
        run(parser.parse_args(argv))
    except (ValueError, OSError, engine.EngineError) as error:
        print(f"benchmark.py: {error}", file=sys.stderr)
        return 2
    return 0


def run(arguments: argparse.Namespace) -> None:
    if arguments.benchmarks == ["report"]:
        report.write(arguments.json or records.RECORDS)
        return
    check_names(arguments.benchmarks)
    device = engine.device(arguments.device)
    if device.type == "cuda":
        torch.cuda.set_device(device)
    commit = arguments.commit or records.commit()
    print(report.HEADER, flush=True)
    for name in arguments.benchmarks:
        parameters = inspect.signature(BENCHMARKS[name]).parameters
        options = {
            key: value
            for key, value in vars(arguments).items()
            if value and key in parameters and key != "device"
        }
        for record in measure(name, device, commit, options):
            print(report.row(record), flush=True)
            if arguments.json:
                with arguments.json.open("a") as file:
                    print(json.dumps(record), file=file)


if __name__ == "__main__":
    sys.exit(main())
