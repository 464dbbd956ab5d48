"""The kernels of PointGoal."""

from pathlib import Path

from megastep.kernels.build.program import Program

__all__ = ["PROGRAM"]

PROGRAM = Program(Path(__file__).parent / "kernels")
