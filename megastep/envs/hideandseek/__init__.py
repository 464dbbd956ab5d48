"""Hide and seek: hiders build shelters of boxes before seekers come, after OpenAI's (Baker et al.
2020, "Emergent Tool Use From Multi-Agent Autocurricula").

N environments of A agents, hiders first, and K bodies: boxes, elongated ones, ramps. Each agent is
a lane: B = N A.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import torch
from pydantic import Field

from megastep import modules, plotting, spaces
from megastep.arrdict import arrdict
from megastep.core import Core
from megastep.engine import checks
from megastep.engine.launch_params import object_params, seed_params
from megastep.envs.common import judged, world_of
from megastep.envs.first_person import FirstPerson, images
from megastep.envs.hideandseek import starts
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import WARP, launch
from megastep.modules.lifecycle import derived_seed
from megastep.scene import FRONT_COLOUR, linear
from megastep.settings import MAX_ENVS, checked
from megastep.types import Geometries

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["HideAndSeek"]

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
PHASE = "max_{}_move_prep", "max_{}_move", "num_{}_lock_prep", "num_{}_lock"
METRICS = "hidden", *(name.format(kind) for kind in ("box", "ramp") for name in PHASE)
N_STARTS = 32  # per layout
REACH = 0.25  # metres from an agent's centre to what it grabs or locks, as in the original
#: Bodies: an agent of 1 kg pushes with 20 N.
BOX: dict = dict(side=0.6, mass=1.0, friction=0.4)
LONG: dict = dict(side=1.2, width=0.2, mass=1.0, friction=0.4)
RAMP: dict = dict(side=0.6, width=0.4, mass=1.0, friction=0.4)
#: Of boxes, elongated ones and ramps; then of what hiders and seekers have locked.
COLOURS = "yellow", "orange", "green", "cyan", "red"
TEAMS = "blue", "magenta"  # colours of hiders and seekers

Team = Annotated[int, Field(ge=1, le=3)]
Count = Annotated[int, Field(ge=0, le=16)]


class HideAndSeek(FirstPerson):
    """Hiders have some time to lock themselves in, or to lock away what others need; then seekers
    look for them.

    Boxes, elongated boxes and ramps are pushed by walking into them, and grabbed and locked. An
    agent that drives up a ramp passes over boxes for 20 steps. In the preparation, seekers are
    blind and cannot act. What a team locked, nobody moves until the team unlocks it.

    Observation:
        A dict of float16, W = ``res / subsample`` pixels (64).

        - ``rgb``, ``d`` and ``imu`` of :class:`~megastep.envs.first_person.FirstPerson`. Hiders are
          blue, seekers magenta, with a red front. Boxes are yellow, elongated ones orange, ramps
          green; what hiders have locked is cyan, and what seekers have red.
        - ``state``: (B, 1, 9): 1 for a hider; 1 in the preparation; the fraction of the phase that
          is left; 1 if the agent has driven up a ramp; 1 if it holds something. Then of what it
          holds, or would grab or lock: 1 if there is such a thing, if its own team locked it, if
          the other team did, if another agent holds it.

    Actions:
        (B, 1) integers: 0 nothing, 1 left, 2 right, 3 forward, 4 back, 5 turn left, 6 turn right,
        which accelerate the agent (:class:`~megastep.modules.MomentumMovement`); 7 grab the nearest
        body within 25 cm and the field of view, or let go; 8 lock what the agent holds, or else the
        nearest, or unlock it.

    Reward:
        In the preparation 0. Then hiders have 1 in each step in which no seeker has a hider in its
        field of view and line of sight, else -1; seekers have the opposite.

    Episode end:
        Terminal after ``limit`` steps, for all agents of an environment.

    Metrics:
        ``hidden``: fraction of the steps after the preparation in which no hider was seen.
        ``max_box_move_prep``: metres that a box, elongated or not, was moved by the end of the
            preparation, at most.
        ``max_box_move``: the same by the end of the episode.
        ``num_box_lock_prep``: boxes that are locked at the end of the preparation.
        ``num_box_lock``: the same at the end of the episode.
        ``max_ramp_move_prep``: as of boxes, and so are the next three.
        ``max_ramp_move``: metres.
        ``num_ramp_lock_prep``: ramps.
        ``num_ramp_lock``: ramps.

    Args:
        geometries: floor plans. Default: quadrants or homes, by the variant, at most 512.
        variant: quadrant: boxes start in the inner room, seekers in the outer one. homes: all start
            anywhere.
        n_hiders: agents that hide.
        n_seekers: agents that seek.
        n_boxes: boxes, 60 cm wide.
        n_long: elongated boxes, 120 x 20 cm.
        n_ramps: ramps, 60 x 40 cm. With boxes, at most 16.
        limit: steps of an episode.
        prep: steps of its preparation. Default: a third in the quadrant, two fifths in homes.
        min_prep: if given, each episode's preparation ends after a random number of steps from this
            to ``prep``. ``state`` is as if it lasted ``prep``, so hiders cannot wait for its end.
        movable: if False, nothing moves the boxes and ramps.
        grab_elevated: agents that have driven up a ramp may grab, and so ride on boxes.
        resample: if True, each episode takes place in a randomly drawn floor plan. Otherwise an
            environment keeps its own.
        privileged: worlds hold ``privileged`` for a critic: of every agent and body the pose, who
            is seen, and what is locked.

    Attributes:
        is_hider: (A,) bool.
        seen: (N, A) bool, hiders that a seeker sees, and seekers that see a hider.
        objects: the :class:`~megastep.modules.Objects`, with the kinds ``box``, ``long`` and
            ``ramp``. Owners are 0 for hiders, 1 for seekers.
    """

    #: Keys of a page that plays it.
    controls = {"ArrowUp": 3, "ArrowDown": 4, "ArrowLeft": 5, "ArrowRight": 6, "a": 1, "d": 2}
    controls |= {"g": 7, "l": 8}

    @checked
    def __init__(
        self,
        n_envs: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 128,
        geometries: Geometries | None = None,
        *,
        variant: Literal["quadrant", "homes"] = "quadrant",
        n_hiders: Team = 2,
        n_seekers: Team = 2,
        n_boxes: Count = 2,
        n_long: Count = 1,
        n_ramps: Count = 1,
        limit: Annotated[int, Field(ge=2, le=10**6)] = 240,
        prep: Annotated[int, Field(ge=0, le=10**6)] | None = None,
        min_prep: Annotated[int, Field(ge=0, le=10**6)] | None = None,
        movable: bool = True,
        grab_elevated: bool = False,
        seed: int = 1,
        device: torch.device | str | None = None,
        res: Annotated[int, Field(ge=1, le=1024)] = 256,
        subsample: Annotated[int, Field(ge=1, le=32)] = 4,
        fov: Annotated[float, Field(gt=0, lt=180)] = 130.0,
        fps: Annotated[float, Field(ge=1, le=1000)] = 10.0,
        resample: bool = False,
        privileged: bool = False,
    ):
        if prep is None:
            prep = limit // 3 if variant == "quadrant" else 2 * limit // 5
        if prep >= limit:
            raise ValueError(f"prep={prep} leaves nothing of limit={limit} steps to play")
        if min_prep is not None and min_prep > prep:
            raise ValueError(f"min_prep={min_prep} is above prep={prep}")
        self.source = self.variant = variant
        self.n_agents, self.n_hiders = n_hiders + n_seekers, n_hiders
        self.limit, self.prep = limit, prep
        kinds = {
            "box": modules.Crate(n_boxes, movable=True, **BOX),
            "long": modules.Crate(n_long, movable=True, **LONG),
            "ramp": modules.Ramp(n_ramps, **RAMP),
        }
        self._grab_elevated = grab_elevated
        self._kinds = {name: kind for name, kind in kinds.items() if kind.count}
        lens: dict = dict(res=res, subsample=subsample, fov=fov, fps=fps)
        super().__init__(n_envs, geometries, seed=seed, device=device, resample=resample, **lens)
        self.objects.all.movable.fill_(movable)
        self.roles = ("hider",) * n_hiders + ("seeker",) * n_seekers
        self.is_hider = torch.arange(self.n_agents, device=self.device) < n_hiders
        constants, n_bodies = LIBRARY.constants, self.objects.all.n_bodies
        self.obs_space["state"] = spaces.MultiVector(1, constants["STATE"], low=0, high=1)
        self.action_space = spaces.MultiDiscrete(1, constants["LOCK"] + 1)
        if privileged:
            n_numbers = constants["PRIVILEGED_PER_AGENT"] * (self.n_agents - 1)
            n_numbers += constants["PRIVILEGED_PER_BODY"] * n_bodies + 1
            self.privileged_space = spaces.MultiVector(1, n_numbers)
        self.rules: dict = dict(
            n_hiders=n_hiders,
            n_boxes=n_boxes,
            n_long=n_long,
            limit=limit,
            prep=prep,
            min_prep=prep if min_prep is None else min_prep,
            view_cosine=math.cos(math.radians(fov / 2)),
            reach=REACH,
            grab_elevated=int(grab_elevated),
        )
        self.n_draws = torch.zeros(n_envs, dtype=torch.int32, device=self.device)
        self.placed = torch.zeros((n_envs, n_bodies, 2), device=self.device)
        self.preps = torch.full((n_envs,), prep, dtype=torch.int32, device=self.device)
        self.tally = torch.zeros((n_envs, constants["TALLY"]), device=self.device)
        self.seen = torch.zeros((n_envs, self.n_agents), dtype=torch.bool, device=self.device)
        self.blind = torch.zeros_like(self.seen)

    def _furnish(self, geometries, resample) -> modules.RandomSpawns:
        core = self.core
        self.seed = derived_seed(core.seed, "hideandseek")
        options: dict = dict(n_points=1, grab_elevated=self._grab_elevated)
        self.objects = modules.Objects(geometries, core, self._kinds, COLOURS, **options)
        layouts = core.scenery.layouts
        textures = layouts.agent_textures.view(len(layouts), self.n_agents, -1, 3)
        is_front = (textures == torch.tensor(FRONT_COLOUR).to(textures)).all(-1, keepdim=True)
        names = [TEAMS[a >= self.n_hiders] for a in range(self.n_agents)]
        colours = torch.tensor(linear([modules.COLOURS[name] for name in names])).to(textures)
        textures.copy_(torch.where(is_front, textures, colours[:, None]))

        is_quadrant = self.variant == "quadrant"
        outer, inner = (starts.OUTER, starts.INNER) if is_quadrant else (starts.ANYWHERE,) * 2
        radii = [core.agents.radius] * self.n_agents
        rooms = [starts.ANYWHERE] * self.n_hiders + [outer] * (self.n_agents - self.n_hiders)
        for name, kind in self._kinds.items():
            radii += [math.hypot(kind.side, kind.width or kind.side) / 2] * kind.count
            rooms += [starts.ANYWHERE if name == "ramp" else inner] * kind.count
        table = starts.starts(geometries, N_STARTS, radii, rooms, self.seed)
        self.starts = torch.from_numpy(table).to(core.device)
        return super()._furnish(geometries, resample)

    @property
    def steps(self) -> torch.Tensor:
        """(N,) int32, steps of the episode so far."""
        return self.ages.view(self.n_envs, -1)[:, 0]

    @property
    def is_prep(self) -> torch.Tensor:
        """(N,) bool, whether hiders still prepare themselves."""
        return self.steps < self.preps

    def _begin(self, mask) -> arrdict:
        whole = mask.view(self.n_envs, -1).any(1, keepdim=True)  # all agents begin together
        return super()._begin(whole.expand(-1, self.n_agents).flatten())

    def desync(self) -> None:
        """Gives every environment a random age, so that episodes do not end together."""
        super().desync()
        ages = self.ages.view(self.n_envs, -1)
        ages.copy_(ages[:, :1].clone())

    def step(self, decision: Mapping) -> arrdict:
        """Takes one step with ``decision.actions`` (B, 1). Returns a world."""
        n_lanes, device = len(self.ended), self.device
        actions = checks.lanes("actions", decision["actions"], n_lanes, device)
        actions = actions.reshape(-1).long().contiguous()
        moves = torch.empty((n_lanes, 1), dtype=torch.int64, device=device)
        launch(
            *(LIBRARY, "hideandseek_moves", device, n_lanes),
            actions=actions,
            ages=self.ages,
            ended=self.ended,
            out=moves,
            n_lanes=n_lanes,
            n_agents=self.n_agents,
            n_hiders=self.n_hiders,
            preps=self.preps,
        )
        self.movement(dict(actions=moves))
        return self._resets.keep(self._world(actions=actions))

    def _world(self, free=None, actions=None) -> arrdict:
        self.spawner(self.ended)
        out, view = self._judge(actions), self._view()
        assert view.depth is not None
        launch(
            *(LIBRARY, "hideandseek_images", self.device, len(self.ended)),
            blind=self.blind,
            rgb=view.rgb,
            depth=view.depth,
            n_lanes=len(self.ended),
            n_pixels=view.depth.shape[-1],
        )
        world = world_of(out, arrdict(images(view), state=out["state"]), METRICS)
        if out["privileged"] is not None:
            world["privileged"] = out["privileged"]
        return world

    def _judge(self, actions) -> dict:
        """Has agents grab and lock by their actions (B,), or None, and sees who is seen."""
        constants, n_critic = LIBRARY.constants, 0
        if self.privileged_space is not None:
            n_critic = self.privileged_space.dim
        return judged(
            *(self, LIBRARY, "hideandseek_step", len(METRICS)),
            *(dict(state=constants["STATE"]), dict(privileged=n_critic), WARP * self.n_envs),
            objects=object_params(self.core.scenery),
            actions=actions,
            starts=self.starts,
            n_starts=N_STARTS,
            placed=self.placed,
            tally=self.tally,
            preps=self.preps,
            n_draws=self.n_draws,
            seen=self.seen,
            blind=self.blind,
            **seed_params(self.seed),
            **self.rules,
        )

    def state(self, e: int = 0) -> arrdict:
        """Returns environment ``e`` for :meth:`plot_state`, (A, ...) of its agents."""
        is_open = ~self.blind[e]
        return arrdict(
            self._seen_by(e).map(lambda leaf: leaf * is_open.view(-1, *[1] * (leaf.ndim - 1))),
            core=arrdict(self.core.state(e), teams=(~self.is_hider).long()),
            age=self.steps[e].clone(),
            left=(self.preps[e] - self.steps[e]).clamp(min=0),
            seen=self.seen[e].clone(),
            is_hider=self.is_hider,
        )

    @classmethod
    def plot_state(cls, state: arrdict) -> "Figure":
        """Draws a numpyified :meth:`state` as a matplotlib figure: the floor plan, with the teams,
        what they hold and have locked in a colour each, and each agent's RGB and depth.
        """
        n_agents, n_seen = len(state.seen), int((state.seen & state.is_hider).sum())
        phase = f"{state.left} steps of preparation" if state.left else f"{n_seen} hiders seen"
        title = f"step {state.age} · {phase}"
        figure, plan, strips = plotting.panels(4 * -(-n_agents // 2), title=title, columns=2)
        Core.plot_state(state.core, plan)
        above = [strips[2 * agent - agent % 2] for agent in range(n_agents)]
        modules.RGB.plot_state(state.rgb, above)
        below = [strips[2 * agent - agent % 2 + 2] for agent in range(n_agents)]
        modules.Depth.plot_state(state.d, below)
        return figure
