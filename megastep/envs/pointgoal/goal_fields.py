"""Goals of layouts: how far it is to each by the shortest way, from anywhere.

D layouts, G goals and S spawn points per layout, H x W cells.
"""

from collections.abc import Sequence

import numpy as np
import torch

from megastep.engine import checks

__all__ = ["GoalFields"]


class GoalFields:
    """What :func:`~megastep.engine.seek` reads. It never changes.

    ``points`` (D, G, 2) float32 and ``spawns`` (D, S, 2) float32 are places in metres.

    Args, a list of D arrays each, in metres: ``points`` (G, 2), the goals; ``fields`` (G, H, W)
    float16, at least 2 x 2 square cells, row 0 at the bottom: how far it is to each goal from the
    centre of a cell, infinite where nothing leads there; ``origins`` (2,), the centre of the first
    cell; ``spawns`` (S, 2); ``lengths`` (S, G) of the shortest ways between the two; ``allowed``
    (S, G) bool: the goals that an agent may be sent to, at least one from each spawn point.
    ``cell`` is the side of a cell. Layouts may share arrays. ValueError if they do not fit each
    other.
    """

    __slots__ = (
        *("_tensors", "addresses", "cell", "device", "n_goals", "n_layouts", "n_spawns"),
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
        self.n_layouts, self.n_goals = len(checks.items("fields", fields)), len(fields[0])
        self.n_spawns = s = len(checks.items("spawns", spawns)[0])
        g = self.n_goals
        given = dict(
            points=points, origins=origins, spawns=spawns, lengths=lengths, allowed=allowed
        )
        shapes = dict(points=(g, 2), origins=(2,), spawns=(s, 2), lengths=(s, g), allowed=(s, g))
        for name, shape in shapes.items():
            each = given[name]
            if len(each) != self.n_layouts or any(np.shape(one) != shape for one in each):
                raise ValueError(
                    f"{name} must be an array {shape} for each of the {self.n_layouts} layouts"
                )
        for field in fields:
            fits = np.ndim(field) == 3 and field.dtype == np.float16 and len(field) == g
            if not fits or min(field.shape[1:]) < 2:
                raise ValueError(
                    f"fields must be float16 ({g}, H, W) of at least 2 x 2 cells, but one is "
                    f"{getattr(field, 'dtype', type(field).__name__)} {np.shape(field)}"
                )
        counts = np.stack([one.sum(1) for one in allowed]).astype(np.int32)
        if not counts.all():
            raise ValueError("allowed must have at least one goal for each spawn point")
        different = {id(field): field for field in fields}
        ends = np.cumsum([field.size for field in different.values()])
        starts = {key: end - field.size for (key, field), end in zip(different.items(), ends)}
        arrays = dict(
            points=np.stack(points).astype(np.float32),
            fields=np.concatenate([field.reshape(-1) for field in different.values()]),
            starts=np.array([starts[id(field)] for field in fields], np.int64),
            shapes=np.array([field.shape[1:] for field in fields], np.int32),
            origins=np.stack(origins).astype(np.float32),
            lengths=np.stack(lengths).astype(np.float32),
            in_range=np.argsort(~np.stack(allowed), axis=2, kind="stable").astype(np.int32),
            n_in_range=counts,
        )
        tensors = {name: torch.from_numpy(array).to(device) for name, array in arrays.items()}
        self._tensors, self.points = tensors, tensors["points"]
        self.spawns = torch.from_numpy(np.stack(spawns).astype(np.float32)).to(device)
        self.device = self.points.device
        #: Where the tensors lie, by the names of the kernel's params.
        self.addresses = {name: tensor.data_ptr() for name, tensor in tensors.items()}
