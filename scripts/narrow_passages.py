"""How narrow the passages of homes are: what wider bodies would miss in PointGoal.

    python scripts/narrow_passages.py

For each source of homes it draws pairs of a spawn point and a goal 1 to 15 m apart by the shortest
path of an agent. For bodies that are wider by some centimetres on each side, it prints the fraction
of pairs without a path, and the SPL of walking such a body's shortest paths.
"""

import numpy as np
import torch

from megastep import engine, geometries
from megastep.envs.pointgoal import geodesics
from megastep.envs.pointgoal.path_graph import PathGraph

SOURCES = {
    "generated homes": ("homes", {}),
    "the same, geometry.density=3": ("homes", dict(density=3.0)),
    "the same, geometry.clutter=1": ("homes", dict(density=3.0, clutter=1.0)),
    "bench homes": ("bench", {}),
}
WIDER = 0.01, 0.02, 0.05, 0.1  # metres on each side
N_HOMES, N_POINTS = 100, 24
NEAREST, FURTHEST = 1, 15  # metres


def lengths(homes: list) -> np.ndarray:
    """Returns the shortest paths of an agent and of each wider body, (1 + len(WIDER), pairs)."""
    device, columns = torch.device("cpu"), []
    for i, home in enumerate(homes):
        generators = [np.random.default_rng(i)]
        graph = PathGraph([home], engine.AGENT_RADIUS, device)
        points = geodesics.draw_points(graph, 3 * N_POINTS, generators)
        goals, spawns = geodesics.largest_part(graph, points, N_POINTS, N_POINTS)
        graphs = [graph]
        graphs += [PathGraph([home], engine.AGENT_RADIUS + wider, device) for wider in WIDER]
        columns.append(np.stack([g.lengths(goals, spawns).numpy().ravel() for g in graphs]))
    found = np.concatenate(columns, 1)
    return found[:, (found[0] >= NEAREST) & (found[0] <= FURTHEST)]


def main() -> None:
    """Prints a table in Markdown."""
    print("| homes | " + " | ".join(f"{100 * wider:g} cm wider" for wider in WIDER) + " |")
    print("| --- |" + " --- |" * len(WIDER))
    for title, (source, options) in SOURCES.items():
        homes = geometries.sample(source, N_HOMES, split="all", seed=1, **options)
        shortest, *others = lengths(homes)
        cells = []
        for other in others:
            spl = np.where(np.isfinite(other), shortest / np.maximum(shortest, other), 0).mean()
            cells.append(f"{np.isinf(other).mean():.1%} without a path, {spl:.2f}")
        print(f"| {title} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
