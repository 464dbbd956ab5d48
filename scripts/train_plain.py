"""Trains with the plain form of fused operations, to tell a kernel's fault from a recipe's.

    python scripts/train_plain.py lstm,critic experiment=deathmatch samples=1e8 seed=1
    python scripts/train_plain.py all experiment=deathmatch samples=1e8 seed=1

The first word names modules of `megastep.agents` whose operations are plain, separated by commas,
or is `none` or `all`; the rest is that of `train.py`. If an agent learns less than it did at an
older commit, train `none` and `all` with the same seed. If they differ by more than seeds do, train
each module alone.
"""

import contextlib
import sys

from megastep.agents.algorithms import ppo, r2d2, vtrace  # noqa: F401  # registers operations
from megastep.agents.cli.entry import run_command
from megastep.agents.networks.fused import OPERATIONS, plain_operations


def chosen(word: str) -> list[str]:
    """Returns the names of operations. ValueError if there is no such module."""
    modules = sorted({name.split(".")[0] for name in OPERATIONS})
    parts = {"all": modules, "none": []}.get(word, word.split(","))
    for part in parts:
        if part not in modules:
            raise ValueError(f"unknown part {part!r}. Available: {', '.join(modules)}, all, none")
    return sorted(name for name in OPERATIONS if name.split(".")[0] in parts)


def main(argv: list[str]) -> int:
    if not argv:
        print(__doc__, file=sys.stderr)
        return 2
    try:
        names = chosen(argv[0])
    except ValueError as error:
        print(f"train_plain.py: {error}", file=sys.stderr)
        return 2
    with plain_operations(*names) if names else contextlib.nullcontext():
        sys.argv = ["train.py", *argv[1:]]
        return run_command("train")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
