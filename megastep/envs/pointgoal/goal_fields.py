"""Goals of layouts, and the length of the shortest path to each goal from anywhere.

D layouts, G goals and S spawn points per layout, H x W cells.
"""

from collections.abc import Sequence

import numpy as np
import torch

from megastep.engine import checks

__all__ = ["GoalFields"]


class GoalFields:
    """The goals of a scenery's layouts, as :func:`~megastep.envs.pointgoal.step.pointgoal_step`
    reads them. Immutable.

    Args:
        points: D arrays (G, 2) metres, the goals.
        fields: D arrays (G, H, W) float16 of at least 2 x 2 square cells, row 0 at the bottom:
            metres to each goal from the centre of a cell by the shortest path, infinite if there is
            none. Layouts may share an array.
        origins: D arrays (2,) metres, the centre of the first cell.
        spawns: D arrays (S, 2) metres, the spawn points.
        lengths: D arrays (S, G) metres, of the shortest paths from spawn points to goals.
        allowed: D arrays (S, G) bool, the goals that may be drawn; at least one per spawn point.
        cell: side of a cell in metres.
        device: where to put the tensors.

    Attributes:
        points: (D, G, 2) float32.
        spawns: (D, S, 2) float32.

    Raises:
        ValueError: naming the argument that does not fit the others.
    """

    __slots__ = (
        *("_tensors", "cell", "device", "n_goals", "n_layouts", "n_spawns"),
        *("points", "spawns"),
    )

    def __init__(
        self,
        points: Sequence[np.ndarray],
        fields: Sequence[np.ndarray],
        origins: Sequence[np.ndarray],
        spawns: Sequence[np.ndarray],
        lengths: Sequence[np.ndarray],
        allowed: Sequence[np.ndarray],
        cell: float,
        device: torch.device | str | None = None,
    ):
        self.cell = checks.number("cell", cell, 0, 1e3, "metres")
        device = None if device is None else checks.device("device", device)
        d = self.n_layouts = len(checks.items("fields", fields))
        g = self.n_goals = len(checks.items("fields[0]", fields[0]))
        s = self.n_spawns = len(checks.items("spawns[0]", checks.items("spawns", spawns)[0]))
        for field in fields:
            fits = np.ndim(field) == 3 and field.dtype == np.float16 and len(field) == g
            if not fits or min(field.shape[1:]) < 2:
                raise ValueError(
                    f"fields must be float16 ({g}, H, W) of at least 2 x 2 cells, but one is "
                    f"{getattr(field, 'dtype', type(field).__name__)} {np.shape(field)}"
                )
        per_layout = dict(
            points=points, origins=origins, spawns=spawns, lengths=lengths, allowed=allowed
        )
        shapes = dict(points=(g, 2), origins=(2,), spawns=(s, 2), lengths=(s, g), allowed=(s, g))
        for name, shape in shapes.items():
            actual_shapes = [np.shape(array) for array in checks.items(name, per_layout[name])]
            if actual_shapes != d * [shape]:
                raise ValueError(f"{name} must have one array {shape} for each of the {d} fields")
        if any(np.asarray(mask).dtype != bool for mask in allowed):
            raise ValueError("allowed must hold True and False")
        is_allowed = np.stack(allowed)
        counts = is_allowed.sum(2, dtype=np.int32)
        if not counts.all():
            raise ValueError("allowed must have at least one goal for each spawn point")
        numbers = dict(
            points=np.stack(points),
            origins=np.stack(origins),
            lengths=np.where(is_allowed, np.stack(lengths), 0.0),  # of others it may be infinite
            spawns=np.stack(spawns),
        )
        tensors = {
            name: checks.floats(name, array, array.shape, device) for name, array in numbers.items()
        }
        distinct = {id(field): field for field in fields}
        ends = np.cumsum([field.size for field in distinct.values()])
        starts = {key: end - field.size for (key, field), end in zip(distinct.items(), ends)}
        arrays = dict(
            fields=np.concatenate([field.reshape(-1) for field in distinct.values()]),
            starts=np.array([starts[id(field)] for field in fields], np.int64),
            shapes=np.array([field.shape[1:] for field in fields], np.int32),
            in_range=np.argsort(~is_allowed, axis=2, kind="stable").astype(np.int32),
            n_in_range=counts,
        )
        tensors |= {name: torch.from_numpy(array).to(device) for name, array in arrays.items()}
        self.points, self.spawns = tensors["points"], tensors.pop("spawns")
        self._tensors, self.device = tensors, self.points.device

    def __setattr__(self, name, value) -> None:
        if hasattr(self, name):
            raise AttributeError(f"{name} of GoalFields cannot be changed: make another GoalFields")
        super().__setattr__(name, value)

    @property
    def addresses(self) -> dict[str, int]:
        """{field of PointgoalStepParams: address}. ValueError if the storage of ``points`` was
        resized.
        """
        checks.address("goals.points", self.points, self.points.shape, torch.float32, self.device)
        return {name: tensor.data_ptr() for name, tensor in self._tensors.items()}
