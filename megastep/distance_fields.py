"""Distances to goals by the shortest way, as fields on square cells that may differ in size from
layout to layout.

D layouts, G goals, H x W cells.
"""

from collections.abc import Sequence

import numpy as np
import torch

from . import checks

__all__ = ["DistanceFields"]


class DistanceFields:
    """For each of G goals in each of D layouts the metres that an agent has to walk from the centre
    of each cell; infinite where it cannot. What :func:`~megastep.engine.to_goal` reads; it never
    changes.

    Args, lists of D arrays: ``points`` (G, 2), the goals; ``fields`` (G, H, W) float16, row 0 at the
    bottom, at least 2 x 2 cells; ``origins`` (2,), the centre of the first cell; and ``cell``, the
    side of one. All in metres. ValueError if they do not fit each other.
    """

    __slots__ = ("_addresses", "_tensors", "cell", "device", "n_goals", "n_layouts", "points")

    def __init__(
        self,
        points: Sequence[np.ndarray],
        fields: Sequence[np.ndarray],
        origins: Sequence[np.ndarray],
        cell: float,
        device: torch.device | str | None = None,
    ):
        self.cell = checks.number("cell", cell, 0, 1e3, "metres")
        self.device = torch.device(device or "cpu")
        self.n_layouts, self.n_goals = len(fields), len(checks.items("fields", fields)[0])
        for name, given, shape in (("points", points, (self.n_goals, 2)), ("origins", origins, (2,))):
            if len(given) != self.n_layouts or any(np.shape(one) != shape for one in given):
                raise ValueError(
                    f"{name} must be one array {shape} for each of the {self.n_layouts} fields"
                )
        for field in fields:
            fits = np.ndim(field) == 3 and field.dtype == np.float16
            if not fits or len(field) != self.n_goals or min(field.shape[1:]) < 2:
                raise ValueError(
                    f"fields must be float16 ({self.n_goals}, H, W) of at least 2 x 2 cells, but one "
                    f"is {getattr(field, 'dtype', type(field).__name__)} {np.shape(field)}"
                )
        different = {id(field): field for field in fields}  # layouts may share theirs
        ends = np.cumsum([field.size for field in different.values()])
        starts = {key: end - field.size for (key, field), end in zip(different.items(), ends)}
        arrays = dict(
            points=np.stack(points).astype(np.float32),
            fields=np.concatenate([field.reshape(-1) for field in different.values()]),
            starts=np.array([starts[id(field)] for field in fields], np.int64),
            shapes=np.array([field.shape[1:] for field in fields], np.int32),
            origins=np.stack(origins).astype(np.float32),
        )
        self._tensors = {
            name: torch.from_numpy(array).to(self.device) for name, array in arrays.items()
        }
        self.device = self._tensors["points"].device
        self.points = self._tensors["points"]
        self._addresses = {name: tensor.data_ptr() for name, tensor in self._tensors.items()}

    def addresses(self) -> dict[str, int]:
        """Where the tensors lie that a kernel reads, by name."""
        return self._addresses
