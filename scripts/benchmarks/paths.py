"""Where the repository is, and where the benchmarks keep their records and figures."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LAB = ROOT / "docs" / "lab"
RECORDS = LAB / "benchmarks.jsonl"
