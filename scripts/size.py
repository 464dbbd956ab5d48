"""Counts how much there is to read: `python scripts/size.py`, with `--ways` three ways through it.

A *way* is what runs from one place to another, imports on the way included, in a new process with
warm caches: the distinct functions and classes of the project (without lambdas, comprehensions and
modules), their files, and the folders of these.
"""

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
#: Not `.venv`, which lies in the root too.
OURS = tuple(str(ROOT / name) for name in ("agents/", "megastep/", "train.py"))
KERNELS = "*.h", "*.cu", "*.cpp"
#: Commands whose way from the settings to the first rollout is measured.
COMMANDS = {
    "explorer": ["env=explorer", "geometry=box"],
    "deathmatch": ["experiment=deathmatch", "geometry=box", "env.n_envs=16"],
    "gymnasium": ["env=gymnasium", "env.id=CartPole-v1", "env.n_envs=8"],
}
WAYS = {
    **{name: f"train.run to the training loop, {name}" for name in COMMANDS},
    "agent": "agent file to a policy that acts",
    "update": "one PPO update",
}


def tracked(folders: list[str], patterns: tuple[str, ...]) -> list[Path]:
    """Returns the files of folders that git tracks and that match a pattern."""
    words = ["git", "-C", str(ROOT), "ls-files", "--", *folders]
    names = subprocess.run(words, check=True, capture_output=True, text=True).stdout.split("\n")
    paths = [ROOT / name for name in names if name and (ROOT / name).is_file()]
    return [path for path in paths if any(path.match(pattern) for pattern in patterns)]


def n_lines(*folders: str, patterns: tuple[str, ...] = ("*.py",)) -> int:
    """Returns the number of lines of the files in folders."""
    return sum(len(path.read_bytes().splitlines()) for path in tracked([*folders], patterns))


def sizes() -> Iterator[tuple[str, int]]:
    """Yields what is counted, and how much of it there is."""
    yield "agents and megastep, lines of Python", n_lines("agents", "megastep")
    yield "agents and megastep, lines of kernels", n_lines("agents", "megastep", patterns=KERNELS)
    yield "scripts, lines of Python", n_lines("scripts")
    yield "tests, lines of Python", n_lines("tests")
    pages = tracked(["docs"], ("*.md",))
    yield "docs, words", sum(len(page.read_text().split()) for page in pages)
    decisions = [page for page in tracked(["docs/decisions"], ("*.md",)) if page.stem != "README"]
    yield "docs/decisions, pages", len(decisions)
    yield "CHANGELOG.md, lines", n_lines("CHANGELOG.md", patterns=("*.md",))
    paths = tracked(["agents", "megastep"], ("*.py",))
    yield "longest file, lines", max(len(path.read_bytes().splitlines()) for path in paths)


class Way:
    """The functions that ran while it recorded.

    Args:
        until: a function, `file.name`, at which recording ends; None: at `end`.
    """

    def __init__(self, until: str | None = None) -> None:
        self.codes: set = set()
        self.until = until

    def begin(self) -> None:
        sys.setprofile(self._profile)

    def end(self) -> None:
        sys.setprofile(None)

    def _profile(self, frame, event, argument) -> None:
        code = frame.f_code
        if event != "call" or not code.co_filename.startswith(OURS):
            return
        if f"{Path(code.co_filename).stem}.{code.co_name}" == self.until:
            self.end()
        elif not code.co_name.startswith("<"):
            self.codes.add(code)

    def __str__(self) -> str:
        files = {Path(code.co_filename).resolve() for code in self.codes}
        n_folders = len({file.parent for file in files})
        return f"{len(self.codes):5} functions {len(files):4} files {n_folders:3} folders"


class SecondUpdate:
    """A callback that records a learner's second update."""

    way = Way()

    def on_rollout(self, trainer, rollout) -> None:
        update = trainer.learner.update

        def recorded(*arguments):
            self.way.begin()
            try:
                return update(*arguments)
            finally:
                self.way.end()

        if trainer.updates == 1:
            trainer.learner.update = recorded


def train(words: list[str], way: Way | None = None) -> None:
    """Trains on the CPU as a command says; a way begins with its checked settings."""
    from megastep.agents.cli import compose
    from megastep.agents.cli.train import COMMAND, run

    ends = "device=cpu", "finish.evaluate=false", "finish.record=false"
    cfg = compose.Composer(COMMAND).settings([*words, *ends])
    if way is not None:
        way.begin()
    run(cfg)


def measure(name: str) -> Way:
    """Returns one of the `WAYS`."""
    way = Way()
    if name in COMMANDS:
        way = Way(until="trainer.train")
        train([*COMMANDS[name], "samples=1", "checkpoints.snapshots=0"], way)
    elif name == "update":
        train([*COMMANDS["explorer"], "samples=2e4", "callbacks=[size:SecondUpdate]"])
        import size  # the callback's module, which is not __main__

        way = size.SecondUpdate.way
    else:
        way.begin()
        from megastep.agents import pretrained

        policy = pretrained.load("explorer_anywhere", "cpu")
        world = zero_world()
        policy(world, policy.initial(1, "cpu"))
    way.end()
    return way


def zero_world() -> Any:
    """Returns a world of one lane of `explorer_anywhere`: its observation space is in its card."""
    import torch

    from megastep.arrdict import arrdict

    image = torch.zeros(1, 1, 3, 1, 64, dtype=torch.float16)
    obs = arrdict(rgb=image, d=image[:, :, :1], imu=torch.zeros(1, 1, 3, dtype=torch.float16))
    zeros, never = torch.zeros(1), torch.zeros(1, dtype=torch.bool)
    return arrdict(obs=obs, reward=zeros, reset=~never, terminal=never, truncated=never)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--ways", action="store_true", help="also measure three ways through it")
    parser.add_argument("--way", choices=WAYS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.way:
        sys.path.insert(0, str(ROOT))
        way = measure(options.way)
        print(way)
        return
    for name, n in sizes():
        print(f"{n:8,}  {name}")
    for way, text in WAYS.items() if options.ways else ():
        words = [sys.executable, __file__, "--way", way]
        with tempfile.TemporaryDirectory() as folder:
            for _ in range(2):  # once for the caches
                done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
        print(f"{done.stdout.splitlines()[-1] if done.returncode == 0 else done.stderr}  {text}")


if __name__ == "__main__":
    main()
