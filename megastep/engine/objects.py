"""Objects: things in an environment that agents see, bump into and carry.

N environments, O objects per environment, P colours, A agents per environment, D layouts.
"""

from collections.abc import Sequence
from typing import Any

import torch

from megastep.engine import checks
from megastep.kernels.build.launch import ENGINE
from megastep.read_only import SetOnce


def _sides(*corners: tuple[float, float]) -> list[tuple[float, ...]]:
    """Returns the ends of each side of a polygon."""
    return [(*a, *b) for a, b in zip(corners, [*corners[1:], corners[0]])]


_HALF = 0.8660254  # of a hexagon's height
#: {shape: the ends (x, y, x, y) of each line it is drawn with, at a size of 1 m}.
SHAPES = {
    "disc": _sides((1, 0), (0.5, _HALF), (-0.5, _HALF), (-1, 0), (-0.5, -_HALF), (0.5, -_HALF)),
    "crate": _sides((-1, -1), (1, -1), (1, 1), (-1, 1)),
    "door": [(-1, 0, 1, 0)],
}
NUMBERS = {name: ENGINE.constants[name.upper()] for name in SHAPES}
_BYTES = ENGINE.constants["OBJECT_BYTES"]
MAX_OBJECTS_IN_ALL = (2**31 - 1) // ENGINE.constants["ERROR_KINDS"]
MAX_OBJECTS = 256  # per environment, so that its lines fit into shared memory


class Objects(SetOnce):
    """The objects of N environments, O each. ``scenery.objects = Objects(...)`` adds them.

    Every environment has the same shapes. All else differs and may be written in place with
    PyTorch. An object that is not ``visible``, or is ``open``, is as if it were not there.

    Cameras see objects, in one colour each. A solid object stops agents and hides what is behind it
    from respawning agents. An agent never sees what it carries.

    Args:
        n_envs: number of environments N.
        shapes: "disc", "crate" or "door" of each object. A disc is drawn as a hexagon, a crate is a
            square, and a door is a segment along its angle.
        palette: (P, 3), linear light in [0, 1], the colours.
        lit: the lights of the layout fall on objects, by one sample each. By default all have full
            light, so that a colour looks the same everywhere.
        names: of the objects, for error messages.
        device: where to put them.

    Attributes:
        records: (N, O, 8) float32, the memory that the tensors below, to ``carriers``, share.
        positions: (N, O, 2) metres. Of a carried object, its carrier's at each render.
        angles: (N, O) degrees.
        sizes: (N, O) metres: the radius of a disc, half the side of a crate, half a door's length.
        colours: (N, O) int32, indices into ``palette``.
        visible: (N, O) bool, at first False.
        solid: (N, O) bool. Carried objects stop nobody.
        open: (N, O) bool.
        carriers: (N, O) int32, the agent that carries it, or -1.
        lines: (N, L, 2, 2), written by every render, those of object 0 first.
        texels: (N, O, 4), red, green, blue and light, written by every render.
        line_starts: (O + 1,) int32, the first line of each object.

    Raises:
        ValueError: naming the argument that does not fit.
    """

    def __init__(
        self,
        n_envs: int,
        shapes: Sequence[str],
        palette: Any,
        lit: bool = False,
        names: Sequence[str] | None = None,
        device: torch.device | str = "cpu",
    ):
        device = checks.device("device", device)
        n = checks.integer("n_envs", n_envs, 1)
        shapes = [
            checks.word("shapes", shape, [*SHAPES]) for shape in checks.items("shapes", shapes)
        ]
        self.n_envs, self.n_objects = n, checks.integer("len(shapes)", len(shapes), 1, MAX_OBJECTS)
        checks.integer("n_envs * len(shapes)", n * len(shapes), 1, MAX_OBJECTS_IN_ALL)
        self.lit = checks.flag("lit", lit)
        self.names = [*names] if names is not None else [f"object {k}" for k in range(len(shapes))]
        self.palette = checks.floats("palette", palette, ("P", 3), device)
        self.n_colours = checks.integer("len(palette)", len(self.palette), 1)
        self.device = device

        self.records = torch.zeros((n, len(shapes), _BYTES // 4), device=device)
        self.sizes.fill_(0.1)
        self.carriers.fill_(-1)
        widths = torch.tensor([len(SHAPES[shape]) for shape in shapes])
        self.shapes = torch.tensor([NUMBERS[s] for s in shapes], dtype=torch.int32, device=device)
        self.line_starts = torch.cat([widths[:1] * 0, widths.cumsum(0)]).int().to(device)
        objects = torch.arange(len(shapes), dtype=torch.int32)
        self.line_object = objects.repeat_interleave(widths).to(device)
        ends = [line for shape in shapes for line in SHAPES[shape]]
        self.ends = torch.tensor(ends, dtype=torch.float32).to(device)
        self.lines = torch.zeros((n, int(widths.sum()), 2, 2), device=device)
        self.texels = torch.zeros((n, len(shapes), 4), device=device)

    # views of records: four floats, two integers, three flags
    positions = property(lambda self: self.records[..., :2])
    angles = property(lambda self: self.records[..., 2])
    sizes = property(lambda self: self.records[..., 3])
    carriers = property(lambda self: self.records.view(torch.int32)[..., 4])
    colours = property(lambda self: self.records.view(torch.int32)[..., 5])
    visible = property(lambda self: self.records.view(torch.bool)[..., 24])
    solid = property(lambda self: self.records.view(torch.bool)[..., 25])
    open = property(lambda self: self.records.view(torch.bool)[..., 26])

    def at_lines(self, lines: torch.Tensor, n_agent_lines: int) -> torch.Tensor:
        """Returns the object, int64 and -1 for none, of each of ``lines`` int32, as in
        ``Render.indices``. Those of agents come first.
        """
        index = lines.long() - n_agent_lines
        is_object = (index >= 0) & (index < len(self.line_object))
        objects = self.line_object.long()[index.clamp(0, len(self.line_object) - 1)]
        return objects.masked_fill(~is_object, -1)
