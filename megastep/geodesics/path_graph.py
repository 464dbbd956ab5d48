"""The visibility graph of homes, and the lengths of the shortest paths of an agent's disc in it.

Corners of polygons around the ends of walls see each other (Lozano-Perez and Wesley 1979);
`kernels/shortest_paths.h` computes paths with the same bits on CPU and GPU. Every passage that is 5
mm wider than an agent is found, and no length is more than a body can walk.

D homes, W walls of all homes, V corners of all homes, G goals per home, P points, H x W cells.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from megastep.devices import threads
from megastep.dotdict import dotdict
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import BLOCK, launch

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
CELL = 0.1  # metres, of fields
SIDES = 16  # of the polygon around the end of a wall
INFLATION = 1.001  # of the radius, as in physics
SLACK = 5e-5  # metres between a path and the clearance that is tested, for rounding
MAX_GOALS, GROUP, KEPT = (LIBRARY.constants[name] for name in ("MAX_GOALS", "GROUP", "KEPT"))
GROUP_SIDE = 1.5  # metres: walls with their middles in one square are neighbours
STEP = 5e-3  # metres from a corner where it is tested if a path can turn there
TURN = 0.026  # radians of that turn


class PathGraph:
    """The walls of homes, and the corners where paths may bend, on a device.

    Args:
        geometries: D of them.
        radius: of the agents, in metres.
        device: where to compute.

    Attributes:
        origins: (D, 2) float32. All points are relative to these.
    """

    def __init__(self, geometries: Sequence[dotdict], radius: float, device: torch.device):
        self.geometries, self.device, self.radius = geometries, device, radius
        n_walls = np.array([len(g.walls) for g in geometries])
        firsts, home = self._starts(n_walls)[:-1], np.repeat(np.arange(len(n_walls)), n_walls)
        walls = np.concatenate([g.walls for g in geometries]).astype(np.float64)
        low = np.minimum.reduceat(walls.min(1), firsts)
        high = np.maximum.reduceat(walls.max(1), firsts)
        self.origins = low.astype(np.float32)
        self.shapes = np.ceil((high - low) / CELL).astype(int)[:, ::-1] + 2  # (D, 2) rows, columns
        walls -= self.origins[home, None]
        self._group(walls, home, n_walls)
        self.tensors["corners"], self.corner_homes = torch.empty((6, 0)), torch.empty(0)
        self.tensors["corner_starts"] = torch.empty(0)
        self.tensors["corners"], self.corner_homes = self._find_corners(walls, home)
        homes = torch.arange(len(n_walls) + 1, dtype=torch.int32, device=device)
        starts = torch.searchsorted(self.corner_homes, homes)
        self.tensors["corner_starts"] = starts.int()
        self.links = self._link()

    def _group(self, walls, home, n_walls) -> None:
        """Sets walls (W, 2, 2), neighbours together, in groups with bounding boxes."""
        cells = (walls.mean(1) / GROUP_SIDE).astype(int)
        walls = walls[np.lexsort((cells[:, 0], cells[:, 1], home))].astype(np.float32)
        n_groups = -(-n_walls // GROUP)
        # the last group of a home is filled up with its last wall
        index = np.arange(GROUP * n_groups.sum()) - np.repeat(
            GROUP * self._starts(n_groups)[:-1], GROUP * n_groups
        )
        index = np.minimum(index, np.repeat(n_walls - 1, GROUP * n_groups))
        walls = walls[index + np.repeat(self._starts(n_walls)[:-1], GROUP * n_groups)]
        grouped = walls.reshape(-1, 2 * GROUP, 2)
        boxes = np.concatenate([grouped.min(1), grouped.max(1)], 1)
        self.n_groups = len(boxes)
        self.tensors = dict(
            walls=self.tensor(walls.reshape(-1, 4).T, np.float32),
            # groups are looked at GROUP at once, so some beyond the last one are read
            boxes=self.tensor(np.append(boxes.T, np.zeros(GROUP)), np.float32),
            group_starts=self.tensor(self._starts(n_groups), np.int32),
        )

    def _starts(self, counts) -> np.ndarray:
        return np.concatenate([[0], np.cumsum(counts)])

    def tensor(self, array, dtype) -> torch.Tensor:
        """Returns an array on the device."""
        return torch.from_numpy(np.ascontiguousarray(array, dtype)).to(self.device)

    def _params(self) -> bytes:
        inradius = INFLATION * self.radius + 2 * SLACK
        circumradius = inradius / np.cos(np.pi / SIDES)
        return LIBRARY.params.HomesParams(
            **self.tensors,
            n_groups=self.n_groups,
            n_corners=len(self.corner_homes),
            n_homes=len(self.geometries),
            n_threads=threads(),
            clearance=inradius - SLACK,
            rebate=(circumradius - inradius) * 2 * np.pi / SIDES,
        )

    # ---- The visibility graph ----

    def _find_corners(self, walls, home) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the corners where a disc fits and a path may turn around the end of a wall:
        columns (6, V) as in HomesParams, and the home of each, (V,) int32, ascending.
        """
        ends, owner = walls.reshape(-1, 2), np.repeat(home, 2)
        order = np.lexsort((*ends.T, owner))
        ends, owner = ends[order], owner[order]
        is_new = np.ones(len(ends), bool)
        is_new[1:] = (ends[1:] != ends[:-1]).any(1) | (owner[1:] != owner[:-1])
        ends, owner = ends[is_new], owner[is_new]

        inradius, side = INFLATION * self.radius + 2 * SLACK, 2 * np.pi / SIDES
        angles = side * (np.arange(SIDES) + 0.5)
        # along the side before a corner and the one behind it, turned a little to the wall's end
        ahead = _directions(angles - side / 2 + np.pi / 2 + TURN)
        back = _directions(angles + side / 2 - np.pi / 2 - TURN)
        ends, owner = self.tensor(ends, np.float64), self.tensor(owner, np.int32)
        corner, fits = inradius / np.cos(side / 2) * _directions(angles), None
        for step in (0.0, STEP * ahead, STEP * back):
            points = (ends[:, None] + self.tensor(corner + step, np.float64)).view(-1, 2)
            candidates = torch.arange(len(points), device=self.device) if fits is None else fits
            clearances = self.clearances(points[candidates], owner[candidates // SIDES], inradius)
            fits = candidates[clearances >= inradius - SLACK]
        sides = [_directions(angles - side / 2), _directions(angles + side / 2)]
        sides = self.tensor(np.concatenate(sides, 1), np.float32)[fits % SIDES]
        corners = (ends[:, None] + self.tensor(corner, np.float64)).view(-1, 2)[fits]
        return torch.cat([corners.float(), sides], 1).T.contiguous(), owner[fits // SIDES]

    def clearances(self, points, home, most) -> torch.Tensor:
        """Returns the metres (P,) float32 from points (P, 2) to the nearest wall of their home, by
        its number (P,) int32; at most `most`.
        """
        clearances = torch.empty(len(points), device=self.device)
        launch(
            *(LIBRARY, "clearances", self.device, len(points)),
            homes=self._params(),
            points=points.float().contiguous(),
            home_index=home,
            clearances=clearances,
            most=most,
            n_points=len(points),
        )
        return clearances

    def _link(self) -> dict[str, torch.Tensor]:
        """Returns the links between corners that see each other: starts (V + 1,) int32, targets
        int32, metres float32.
        """
        v, device = len(self.corner_homes), self.device
        counts = torch.empty(v, dtype=torch.int32, device=device)
        kept = torch.empty((v, KEPT), dtype=torch.int32, device=device)
        always = dict(homes=self._params(), corner_homes=self.corner_homes, kept=kept)
        where = LIBRARY, "corner_links", device, v
        launch(*where, **always, counts=counts, starts=None, targets=None, metres=None)
        ends = counts.cumsum(0, dtype=torch.int32)
        n_links = int(ends[-1]) if v else 0
        links = dict(
            starts=torch.cat([torch.zeros_like(ends[:1]), ends]),
            targets=torch.empty(n_links, dtype=torch.int32, device=device),
            metres=torch.empty(n_links, device=device),
        )
        launch(*where, **always, counts=None, **links)
        return links

    # ---- Shortest paths ----

    def lengths(self, goals, points) -> torch.Tensor:
        """Returns the lengths of the shortest paths from points (D, K, 2) to goals (D, G, 2), as
        (D, G, K) float32. Infinite where there is no path.
        """
        counts = np.full(points.shape[0], points.shape[1])
        lengths = self._all_lengths(goals, counts, self.tensor(points, np.float32))
        return lengths.view(len(points), -1, points.shape[1])

    def fields(self, goals) -> list[np.ndarray]:
        """Returns the lengths of the shortest paths from all cells to goals (D, G, 2), as float16
        (G, H, W) of each home.
        """
        shapes = [(goals.shape[1], *shape) for shape in self.shapes.tolist()]
        lengths = self._all_lengths(goals, self.shapes.prod(1)).half().cpu().numpy()
        ends = np.prod(shapes, 1).cumsum()[:-1]
        return [field.reshape(s) for field, s in zip(np.split(lengths, ends), shapes)]

    def _all_lengths(self, goals, counts, points=None) -> torch.Tensor:
        """Returns lengths (P * G,), for each home G rows, from points (P, 2), by default the
        centres of all cells, ``counts`` (D,) in each home, to goals (D, G <= MAX_GOALS, 2).
        """
        n_goals = goals.shape[1]
        if n_goals > MAX_GOALS:
            raise ValueError(f"{n_goals} goals per home: at most {MAX_GOALS} in one call")
        goals = self.tensor(goals, np.float32)
        distances = torch.empty((len(self.corner_homes), MAX_GOALS), device=self.device)
        launch(
            *(LIBRARY, "corner_distances", self.device, BLOCK * len(counts)),
            homes=self._params(),
            goals=goals,
            distances=distances,
            n_goals=n_goals,
            **self.links,
        )
        n_points = int(counts.sum())
        lengths = torch.empty(n_points * n_goals, device=self.device)
        launch(
            *(LIBRARY, "path_lengths", self.device, n_points),
            homes=self._params(),
            goals=goals,
            distances=distances,
            points=points,
            widths=self.tensor(self.shapes[:, 1], np.int32),
            point_starts=self.tensor(self._starts(counts), np.int32),
            lengths=lengths,
            hints=torch.empty(len(self.corner_homes), dtype=torch.int32, device=self.device),
            cell=CELL,
            n_points=n_points,
            n_goals=n_goals,
        )
        return lengths


def _directions(angles) -> np.ndarray:
    return np.stack([np.cos(angles), np.sin(angles)], 1)
