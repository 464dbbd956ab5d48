"""Records of measurements: where each was made, and the newest of each.

A record is a measurement with the benchmark's name, machine, commit, date and command. It is a line
of JSON in docs/lab/benchmarks.jsonl. Old records stay as they are, so keys and names never change.
"""

import json
import re
import subprocess
from datetime import date
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parents[2]
RECORDS = ROOT / "docs" / "lab" / "benchmarks.jsonl"


def read(path: Path) -> list[dict]:
    """Returns the records in a file of JSON lines."""
    return [json.loads(line) for line in path.read_text().splitlines()]


def newest(records: list[dict]) -> list[dict]:
    """Returns the newest record of each measurement per GPU model, and on any CPU.

    They are in order of benchmark, machine and name. Two names are the same measurement if they
    differ only in the last six digits of a number of samples, or in what they count in brackets.
    """
    newest_records = {}
    for record in sorted(records, key=lambda record: record["date"]):
        machine = "CPU" if record["on"].startswith("CPU") else record["on"]
        what = re.sub(r" \(\d+ won, .*?\)", "", record["what"])
        what = re.sub(r",\d{3},\d{3} samples", " M samples", what)
        newest_records[record["benchmark"], machine, what] = record

    def order(key):
        benchmark, machine, what = key
        parts = re.split(r"(\d[\d,]*)", what)
        numbers = [int(part.replace(",", "")) for part in parts[1::2]]
        return benchmark, machine == "CPU", machine, parts[::2], numbers

    return [newest_records[key] for key in sorted(newest_records, key=order)]


# ---- Where a measurement was made ----


def output_of(*command: str) -> str:
    """Returns what a command prints, or "" if it is missing or fails."""
    try:
        completed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    except OSError:
        return ""
    return "" if completed.returncode else completed.stdout.strip()


def commit() -> str:
    """Returns the current commit, with a + if the tree differs from it outside of docs/."""
    changes = output_of("git", "status", "--porcelain", "-uno", "--", ".", ":!docs")
    return (output_of("git", "rev-parse", "--short", "HEAD") or "unknown") + (
        "+" if changes else ""
    )


def machine(device: torch.device) -> dict:
    """Returns a record's fields about hardware and drivers."""
    if device.type == "cuda":
        query = "nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"
        name, cuda = torch.cuda.get_device_name(device), torch.version.cuda
        driver = output_of(*query).partition("\n")[0] or "unknown"
    else:
        cpuinfo = Path("/proc/cpuinfo")
        text = cpuinfo.read_text() if cpuinfo.exists() else ""
        models = re.findall(r"model name\s*: (.*)", text) or ["unknown"]
        name = f"CPU, {torch.get_num_threads()} threads of {models[0].strip()}"
        driver, cuda = None, None
    return dict(on=name, driver=driver, torch=torch.__version__, cuda=cuda)


def provenance(device: torch.device, commit: str) -> dict:
    """Returns a record's fields about where, when and of which commit it was made."""
    return machine(device) | dict(commit=commit, date=str(date.today()))
