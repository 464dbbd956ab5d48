"""Writes episodes of PointGoal for any simulator: walls, starts, goals, shortest paths.

    python episodes.py homes homes.npz --n-homes 200 --n 1000
    python episodes.py houseexpo maps.npz --split all    # after `megastep import`
    python episodes.py home.npz maps.npz                 # or any file of geometries

Homes are of the test split by default, starts and goals are drawn as in training. A file has
`walls` (W, 2, 2) of all homes, `first_wall` (D + 1,), `names` (D,), and per episode `home`, `start`
(x, y, radians), `goal` (x, y) and `shortest`, in metres.
"""

import argparse
import math
import sys
from typing import NamedTuple

import numpy as np


class Episode(NamedTuple):
    """One of a file, with the walls of its home."""

    number: int
    home: int
    walls: np.ndarray  # (W, 2, 2) metres
    start: np.ndarray  # (3,) x, y, radians
    goal: np.ndarray  # (2,)
    shortest: float  # metres


def write(
    source: str, path: str, n: int, n_homes: int, seed: int, robot: dict, split: str = "test"
) -> None:
    """Writes n episodes in homes of a source (homes, mazes ...) or of a file of geometries."""
    from megastep import envs, geometries, modules  # noqa: I001
    import torch

    if source.endswith(".npz"):
        homes = geometries.sample("files", 1000, split="all", path=source)
        homes = [*{id(home): home for home in homes}.values()][:n_homes]
    else:
        homes = geometries.sample(source, n_homes, split=split, seed=seed)
    env = envs.PointGoal(
        n, homes, robot=modules.Robot(**robot), resample=True, seed=seed, device="cpu"
    )
    env.reset()
    home = env.layout.long()
    starts = torch.cat([env.core.agents.positions[:, 0], torch.deg2rad(env.core.agents.angles)], 1)
    np.savez_compressed(
        path,
        walls=np.concatenate([g.walls for g in homes]).astype(np.float32),
        first_wall=np.cumsum([0, *(len(g.walls) for g in homes)]),
        names=np.array([str(g.id) for g in homes]),
        home=home.numpy(),
        start=starts.numpy(),
        goal=env.goals.points[home, env.goal_index.long()].numpy(),
        shortest=env.progress[4].numpy(),
    )


def read(path: str) -> list[Episode]:
    """Returns the episodes of a file."""
    with np.load(path) as file:
        data = {name: file[name] for name in file.files}
    ends, episodes = data["first_wall"], []
    for i, home in enumerate(data["home"].tolist()):
        walls = data["walls"][ends[home] : ends[home + 1]]
        where = data["start"][i], data["goal"][i], float(data["shortest"][i])
        episodes.append(Episode(i, home, walls, *where))
    return episodes


def to_robot(pose: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Returns a point (2,) in the frame of a robot at a pose (x, y, radians)."""
    (dx, dy), c, s = point - pose[:2], math.cos(pose[2]), math.sin(pose[2])
    return np.array([c * dx + s * dy, c * dy - s * dx])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("source")
    parser.add_argument("file")
    parser.add_argument("--n", type=int, default=1000)
    parser.add_argument("--n-homes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--split", default="test", choices=["training", "test", "all"])
    parser.add_argument("--radius", type=float, default=0.17)
    words = parser.parse_args()
    try:
        how = words.n, words.n_homes, words.seed, dict(radius=words.radius), words.split
        write(words.source, words.file, *how)
    except ValueError as error:  # no goal can be reached, a robot that fits through no door
        print(f"episodes.py: {error}", file=sys.stderr)
        sys.exit(2)
