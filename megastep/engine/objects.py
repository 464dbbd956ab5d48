"""Objects: things in an environment that agents see, bump into, carry and push.

N environments, O objects per environment, B of which are bodies, P colours, A agents per
environment, D layouts.
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
    "ramp": _sides((-1, -1), (1, -1), (1, 1), (-1, 1))[:3],
}
NUMBERS = {name: ENGINE.constants[name.upper()] for name in SHAPES}
_BYTES, _BODY_BYTES = ENGINE.constants["OBJECT_BYTES"], ENGINE.constants["BODY_BYTES"]
MAX_BODIES = ENGINE.constants["MAX_BODIES"]  # per environment
FORCE, GRIP = 20.0, 40.0  # newtons
RAMP_STEPS = 20
MAX_FORCE = 1e6  # newtons
MAX_MASS = 1e6  # kg
MAX_OBJECTS_IN_ALL = (2**31 - 1) // ENGINE.constants["ERROR_KINDS"]
MAX_OBJECTS = 256  # per environment, so that its lines fit into shared memory


class Objects(SetOnce):
    """The objects of N environments, O each. ``scenery.objects = Objects(...)`` adds them.

    Every environment has the same shapes. All else differs and may be written in place with
    PyTorch. An object that is not ``visible``, or is ``open``, is as if it were not there.

    Cameras see objects, in one colour each. A solid object stops agents and hides what is behind it
    from respawning agents. An agent never sees what it carries. Bodies are objects that
    :func:`physics` moves: agents push them, and they push each other.

    Args:
        n_envs: number of environments N.
        shapes: "disc", "crate", "door" or "ramp" of each object. A disc is drawn as a hexagon, a
            crate is a square, and a door is a segment along its angle. A ramp is a crate without
            its side at -x, which is low: an agent drives over that one, and is elevated at +x.
        palette: (P, 3), linear light in [0, 1], the colours.
        lit: the lights of the layout fall on objects, by one sample each. By default all have full
            light, so that a colour looks the same everywhere.
        names: of the objects, for error messages.
        device: where to put them.
        widths: of crates and ramps, as a fraction of their length, above 0 and at most 1.
            Default: squares.
        movable: of each object, if it is a body. Doors cannot be, ramps must be. Default: none are.
        force: newtons, at most, by which an agent of 1 kg pushes.
        grip: newtons, at most, between an agent and what it holds.
        n_agents: agents per environment A. Needed with ramps.
        ramp_steps: steps for which an agent is elevated after it has driven up a ramp, and longer
            until it is over no body. It passes bodies then, but neither walls nor agents.
        grab_elevated: elevated agents may hold bodies.

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
        bodies: (N, B, 12) float32, the memory that the tensors below share.
        body_slots: {object: its index among the bodies}.
        velocity: (N, B, 2) m/s.
        angvelocity: (N, B) deg/s.
        masses: (N, B) kg, at first 1.
        frictions: (N, B), coefficient with the floor, at first 0.5.
        holders: (N, B) int32, the agent that holds it, or -1.
        owners: (N, B) int32, the team that locked it, or -1.
        movable: (N, B) bool, at first True. Else it is as if its mass were infinite.
        locked: (N, B) bool. True: likewise.
        grabbed: (N, B) bool, held since the last step.
        elevated: (N, A) int32, if there are ramps, else None. Above 0: steps for which the agent is
            elevated, at least. Below 0: -1 - the index of the ramp that it is driving up.

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
        widths: Sequence[float] | None = None,
        movable: Sequence[bool] | None = None,
        force: float = FORCE,
        grip: float = GRIP,
        n_agents: int = 0,
        ramp_steps: int = RAMP_STEPS,
        grab_elevated: bool = False,
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
        widths = [1.0] * len(shapes) if widths is None else [*widths]
        movable = [False] * len(shapes) if movable is None else [*movable]
        if not len(widths) == len(movable) == len(shapes):
            raise ValueError("widths and movable must have one entry per object")
        if any(map(lambda shape, moves: moves and shape == "door", shapes, movable)):
            raise ValueError("movable must be False for doors: only discs and crates can be pushed")
        ramps = [moves for shape, moves in zip(shapes, movable) if shape == "ramp"]
        if not all(ramps):
            raise ValueError("movable must be True for ramps")
        bodies = [k for k, moves in enumerate(movable) if moves]
        if len(bodies) > MAX_BODIES:
            raise ValueError(
                f"an environment has at most {MAX_BODIES} movable objects, but {len(bodies)} were "
                "given"
            )
        self.force = checks.number("force", force, 0, MAX_FORCE, "newtons")
        self.grip = checks.number("grip", grip, 0, MAX_FORCE, "newtons")
        self.ramp_steps = checks.integer("ramp_steps", ramp_steps, 1, 2**31 - 1)
        self.grab_elevated = int(checks.flag("grab_elevated", grab_elevated))

        self.records = torch.zeros((n, len(shapes), _BYTES // 4), device=device)
        self.sizes.fill_(0.1)
        self.carriers.fill_(-1)
        n_lines = torch.tensor([len(SHAPES[shape]) for shape in shapes])
        self.shapes = torch.tensor([NUMBERS[s] for s in shapes], dtype=torch.int32, device=device)
        self.line_starts = torch.cat([n_lines[:1] * 0, n_lines.cumsum(0)]).int().to(device)
        objects = torch.arange(len(shapes), dtype=torch.int32)
        self.line_object = objects.repeat_interleave(n_lines).to(device)
        ends = [
            (ax, ay * width, bx, by * width) if shape in ("crate", "ramp") else (ax, ay, bx, by)
            for shape, width in zip(shapes, widths)
            for ax, ay, bx, by in SHAPES[shape]
        ]
        self.ends = torch.tensor(ends, dtype=torch.float32).to(device)
        self.lines = torch.zeros((n, int(n_lines.sum()), 2, 2), device=device)
        self.texels = torch.zeros((n, len(shapes), 4), device=device)
        self.widths = torch.tensor(widths, dtype=torch.float32, device=device)

        self.n_bodies = len(bodies)
        self.body_slots = {k: slot for slot, k in enumerate(bodies)}
        slots = [self.body_slots.get(k, -1) for k in range(len(shapes))]
        self.object_bodies = torch.tensor(slots, dtype=torch.int32, device=device)
        self.body_objects = torch.tensor(bodies, dtype=torch.int32, device=device)
        self.bodies = torch.zeros((n, len(bodies), _BODY_BYTES // 4), device=device)
        self.masses.fill_(1)
        self.frictions.fill_(0.5)
        self.holders.fill_(-1)
        self.owners.fill_(-1)
        self.movable.fill_(True)
        agents = (n, checks.integer("n_agents", n_agents, 1)) if ramps else None
        self.elevated = agents and torch.zeros(agents, dtype=torch.int32, device=device)

    # views of records: four floats, two integers, three flags
    positions = property(lambda self: self.records[..., :2])
    angles = property(lambda self: self.records[..., 2])
    sizes = property(lambda self: self.records[..., 3])
    carriers = property(lambda self: self.records.view(torch.int32)[..., 4])
    colours = property(lambda self: self.records.view(torch.int32)[..., 5])
    visible = property(lambda self: self.records.view(torch.bool)[..., 24])
    solid = property(lambda self: self.records.view(torch.bool)[..., 25])
    open = property(lambda self: self.records.view(torch.bool)[..., 26])
    # views of bodies: five floats, an integer, three floats, an integer, three flags
    velocity = property(lambda self: self.bodies[..., :2])
    angvelocity = property(lambda self: self.bodies[..., 2])
    masses = property(lambda self: self.bodies[..., 3])
    frictions = property(lambda self: self.bodies[..., 4])
    holders = property(lambda self: self.bodies.view(torch.int32)[..., 5])
    owners = property(lambda self: self.bodies.view(torch.int32)[..., 9])
    movable = property(lambda self: self.bodies.view(torch.bool)[..., 40])
    locked = property(lambda self: self.bodies.view(torch.bool)[..., 41])
    grabbed = property(lambda self: self.bodies.view(torch.bool)[..., 42])

    def at_lines(self, lines: torch.Tensor, n_agent_lines: int) -> torch.Tensor:
        """Returns the object, int64 and -1 for none, of each of ``lines`` int32, as in
        ``Render.indices``. Those of agents come first.
        """
        index = lines.long() - n_agent_lines
        is_object = (index >= 0) & (index < len(self.line_object))
        objects = self.line_object.long()[index.clamp(0, len(self.line_object) - 1)]
        return objects.masked_fill(~is_object, -1)
