"""A base of environments in which agents walk through a floor plan and see by cameras."""

import inspect
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

import torch
from pydantic import Field
from torch.utils._pytree import tree_leaves

from megastep import engine, modules, plotting, spaces
from megastep import geometries as sources
from megastep.arrdict import arrdict
from megastep.core import AGENT_RADIUS, Core
from megastep.dotdict import dotdict
from megastep.envs.common import SceneryEnv
from megastep.scene import scenery, spread
from megastep.settings import MAX_ENVS, checked
from megastep.types import Geometries

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def images(view: engine.Observation) -> arrdict:
    """Returns ``rgb`` (B, 1, 3, C, P), ``d`` (B, 1, 1, C, P), ``imu`` (B, 1, 3); C cameras."""
    rgb, d = view.rgb, view.depth
    assert rgb is not None and d is not None and view.imu is not None
    lanes, pixels = (d.shape[0] * d.shape[1], 1), d.shape[-1]
    rgb = rgb.view(*lanes, -1, 3, pixels).transpose(2, 3)
    return arrdict(rgb=rgb, d=d.view(*lanes, 1, -1, pixels), imu=view.imu.view(*lanes, 3))


class FirstPerson(SceneryEnv):
    """N environments of agents that momentum moves, by default one each. A subclass defines
    ``_world``, and may take the arguments below as ``*shared`` and ``**options``, which it passes
    on.

    Observation:
        A dict of float16, for each of C cameras (1) W = ``res / subsample`` pixels (64).

        - ``rgb``: (B, 1, 3, C, W), linear light. A pixel is the mean of ``subsample`` rays.
        - ``d``: (B, 1, 1, C, W), depth: 1 at the agent's edge, 0 at 10 m and beyond.
        - ``imu``: (B, 1, 3), angular velocity / 360 deg/s, velocity forward and left / 10 m/s.

    Actions:
        (B, 1) integers: 0 nothing, 1 left, 2 right, 3 forward, 4 back, 5 turn left, 6 turn right.
        They accelerate the agent (:class:`~megastep.modules.MomentumMovement`).

        With ``control="continuous"``: (B, 1, 3) float32 from -1 to 1: push ahead, push left, turn
        left. 1 does what the action forward, left or turn left does; numbers beyond are clipped.

        With ``control="differential"``: (B, 1, 2) float32, the speed ahead in m/s and the rate of
        turning left in rad/s, within the limits of a :class:`~megastep.modules.Robot`
        (:class:`~megastep.modules.DifferentialMovement`).

    Args:
        n_envs: number of environments, N.
        geometries: floor plans. Default: generated ones, at most 512.
        seed: of everything random: textures, lights, spawns, and floor plans drawn by default.
        device: where the tensors are. Default: a GPU if there is one.
        res: rays per camera.
        subsample: rays per pixel; divides ``res``.
        fov: field of view of a camera, degrees.
        cameras: yaw of each camera, degrees; 0 looks ahead, 90 left.
        fps: steps per second of simulated time.
        control: discrete, continuous or differential actions.
        slide: whether walls deflect an agent with differential control. Otherwise they stop it.
        resample: if True, each episode takes place in a randomly drawn floor plan. Otherwise an
            environment keeps its own.

    Attributes:
        ages: (B,) int32, steps since the first observation.
        ended: (B,) bool, whether the last step ended the episode.
    """

    n_agents = 1
    #: Source of the floor plans by default.
    source = "homes"
    #: The robot that the agents are. None: they are discs that see by cameras.
    robot: modules.Robot | None = None
    #: Set in a class, not for subclasses, whose worlds hold what `_view` and `judged` made alone.
    begins_in_place: bool
    #: Steps after which an episode is truncated.
    limit: int

    def __init_subclass__(cls, **options: Any) -> None:
        """Gives a constructor's signature, which settings are made from, the arguments above."""
        super().__init_subclass__(**options)
        init: Any = cls.__init__
        own = inspect.signature(init).parameters
        if "shared" in own:
            named = {**inspect.signature(FirstPerson.__init__).parameters}
            named |= {name: one for name, one in own.items() if one.kind is one.KEYWORD_ONLY}
            init.__signature__ = inspect.Signature([*named.values()])
            init.__annotations__ = FirstPerson.__init__.__annotations__ | init.__annotations__

    @checked
    def __init__(
        self,
        n_envs: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 128,
        geometries: Geometries | None = None,
        *,
        seed: int = 1,
        device: torch.device | str | None = None,
        res: Annotated[int, Field(ge=1, le=1024)] = 256,
        subsample: Annotated[int, Field(ge=1, le=32)] = 4,
        fov: Annotated[float, Field(gt=0, lt=180)] = 130.0,
        cameras: Annotated[Sequence[float], Field(min_length=1, max_length=16)] = (0.0,),
        fps: Annotated[float, Field(ge=1, le=1000)] = 10.0,
        control: Literal["discrete", "continuous", "differential"] = "discrete",
        slide: bool = False,
        resample: bool = False,
    ):
        if geometries is None:
            geometries = sources.sample(self.source, min(n_envs, 512), seed=seed)
        geometries = geometries if resample else spread(geometries, n_envs)
        plans = scenery(geometries, self.n_agents, n_envs=n_envs, seed=seed, device=device)
        robot = self.robot
        radius = AGENT_RADIUS if robot is None else robot.radius
        self.core = Core(plans, res, fov, fps, cameras, seed, radius)
        self.n_envs, self.device, self.fps = n_envs, self.core.device, self.core.fps
        self.subsample, n_pixels = subsample, len(modules.downsample(torch.empty(res), subsample))
        self.spawner = self._furnish(geometries, resample)
        if robot is None and control != "differential":
            self.movement = modules.MomentumMovement(self.core, control=control)
        else:
            self.movement = modules.DifferentialMovement(self.core, robot, slide=slide)
        self.action_space = self.movement.space
        self.obs_space = dotdict(
            rgb=spaces.MultiImage(1, 3, len(cameras), n_pixels, low=0, high=1),
            d=spaces.MultiImage(1, 1, len(cameras), n_pixels, low=0, high=1),
            imu=spaces.MultiVector(1, 3),
        )
        engine.fit(n_envs, self.n_agents * (8 * len(cameras) * n_pixels + 64), self.device)
        n_lanes = n_envs * self.n_agents
        self.ages = torch.zeros(n_lanes, dtype=torch.int32, device=self.device)
        self.ended = torch.zeros_like(self.ages, dtype=torch.bool)
        self._resets = engine.Resets()
        self.privileged_space = None

    def _furnish(self, geometries: Sequence, resample: bool) -> modules.RandomSpawns:
        """Puts into the floor plans what the game needs. Returns the spawner."""
        return modules.RandomSpawns(geometries, self.core, resample=resample)

    def _begin(self, mask) -> arrdict:
        if self._resets.mask is None:  # otherwise `_begins` is the mask
            self.ended.copy_(mask)
        return self._world()

    def _begin_in_place(self, mask) -> bool:
        parts = type(self.movement), type(self.spawner)
        is_known = parts == (modules.MomentumMovement, modules.RandomSpawns)
        if "begins_in_place" not in vars(type(self)) or not is_known:
            return False
        if self._resets.parts.get("world") is not self._resets.last:
            return False  # the last world may come from elsewhere, such as a checkpoint
        mask, changed = mask.contiguous(), (self.ended, *tree_leaves(self._resets.last))
        if any(mask.data_ptr() == leaf.data_ptr() for leaf in changed):
            mask = mask.clone()
        self._resets.mask = mask
        try:
            self._begin(mask)
        finally:
            self._resets.mask = None
        return True

    @property
    def _begins(self) -> torch.Tensor:
        """(B,) bool: lanes whose episode begins in this step, or in a reset in place."""
        return self.ended if self._resets.mask is None else self._resets.mask

    def desync(self) -> None:
        """Gives every lane a random age, from the seed, so that episodes do not end together."""
        limits = torch.full_like(self.ages, self.limit)
        self.ages.copy_(modules.random_ages(limits, self.core.seed))

    def step(self, decision: Mapping) -> arrdict:
        """Takes one step by ``decision["actions"]``, (B, 1) or (B, 1, 3). Returns a world."""
        return self._resets.keep(self._world(self.movement(decision).progress))

    def _world(self, free: torch.Tensor | None = None) -> arrdict:
        """Respawns, judges and renders; ``free``: (N, A), the step's free fraction, or None."""
        raise NotImplementedError

    def _view(self, core: Core | None = None, **seen: Any) -> engine.Observation:
        """Returns what all cameras see, or those of a core. ``seen``: as ``engine.observe``."""
        parts, mask, of = self._resets.parts, self._resets.mask, core or self.core
        if core is None and mask is not None:
            seen |= dict(only=modules.to_agents(mask, self.n_agents), out=parts["view"])
        view = engine.observe(of.scenery, of.agents, self.subsample, imu=True, **seen)
        if core is None:
            parts["view"] = view
        return view

    def truth(self) -> arrdict:
        """Returns what no agent observes, (B, ...) float32: ``agent_pos`` (2), metres;
        ``agent_dir`` (2), the unit vector ahead; with objects ``targets_pos`` (K, 2), metres, and
        ``targets_vec`` (K, 2), metres ahead and to the left. Games with a goal add ``target_pos``
        and ``target_vec``.
        """
        agents, objects = self.core.agents, self.core.scenery.objects
        angles = torch.deg2rad(agents.angles.flatten())
        found = arrdict(
            agent_pos=agents.positions.flatten(0, 1).clone(),
            agent_dir=torch.stack([angles.cos(), angles.sin()], -1),
        )
        if objects is not None:
            places = objects.positions.repeat_interleave(self.n_agents, 0)
            ahead = self._ahead(found, places)
            found = arrdict(found, targets_pos=places, targets_vec=ahead)
        return found

    @staticmethod
    def _ahead(found: Mapping, places: torch.Tensor) -> torch.Tensor:
        """Returns metres ahead and to the left of agents, (B, ..., 2), to places (B, ..., 2)."""
        shape = len(places), *[1] * (places.ndim - 2), 2
        x, y = found["agent_dir"].view(shape).unbind(-1)
        dx, dy = (places - found["agent_pos"].view(shape)).unbind(-1)
        return torch.stack([dx * x + dy * y, dy * x - dx * y], -1)

    def _with_target(self, found: arrdict, places: torch.Tensor) -> arrdict:
        """Adds the place (B, 2) that each agent is to reach."""
        return arrdict(found, target_pos=places, target_vec=self._ahead(found, places))

    def _seen_by(self, e: int) -> arrdict:
        """Returns the observations of environment ``e``'s agents, (A, ...)."""
        return images(self._view(self.core.alone(e))).map(lambda leaf: leaf.squeeze(1))

    @classmethod
    def _draw(
        cls, state: arrdict, title: str, goal: tuple | None = None, seen: Any = None
    ) -> "Figure":
        """Draws a numpyified state: the floor plan, with a ring around ``goal``, (place, radius in
        metres), above the agent's RGB and depth. ``seen``: as :meth:`Core.plot_state`.
        """
        yaws = state.core.yaws
        figure, plan, strips = plotting.panels(2, title=title, n_cameras=len(yaws))
        Core.plot_state(state.core, plan, seen)
        if goal is not None:
            plotting.plot_goal(plan, *goal)
        modules.RGB.plot_state(state.rgb, strips[:1], yaws)
        modules.Depth.plot_state(state.d, strips[1:], yaws)
        return figure
