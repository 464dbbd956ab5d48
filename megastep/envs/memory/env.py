"""Memory: find coloured objects in a maze, again and again. N environments of one agent."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Literal

import torch
from pydantic import Field

from megastep import engine, modules, plotting, spaces
from megastep import geometries as sources
from megastep.arrdict import arrdict
from megastep.core import Core
from megastep.dotdict import dotdict
from megastep.envs.common import SceneryEnv, images
from megastep.envs.memory.arrangements import arrangements
from megastep.envs.memory.step import N_GOAL, memory_step
from megastep.modules.objects import REACH
from megastep.scene import scenery, spread
from megastep.settings import MAX_ENVS, checked
from megastep.types import Geometries

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Memory"]

RADIUS = 0.2  # metres, of objects
N_ARRANGEMENTS = 64  # of objects, per layout
PLAIN = 0.4  # linear light, the grey of walls of one colour


class Memory(SceneryEnv):
    """Memory Maze's task (Pasukonis et al. 2022): find the object of a colour, then the next.

    Objects of distinct colours lie in a maze, each in a room of its own if there are as many rooms.
    Maze and objects stay the same for an episode. So an agent that remembers where it saw each
    finds them faster.

    Observation:
        A dict of float16, for each of C cameras (1) W = ``res / subsample`` pixels (64).

        - ``rgb``: (B, 1, 3, C, W), linear light. A pixel is the mean of ``subsample`` rays.
        - ``d``: (B, 1, 1, C, W), depth: 1 at the agent's edge, 0 at 10 m and beyond.
        - ``imu``: (B, 1, 3), angular velocity / 360 deg/s, velocity forward and left / 10 m/s.
        - ``cue``: (B, 1, 3), linear light, the colour of the object to find, as ``rgb`` shows it.

    Actions:
        (B, 1) integers: 0 nothing, 1 left, 2 right, 3 forward, 4 back, 5 turn left, 6 turn right.
        They accelerate the agent (:class:`~megastep.modules.MomentumMovement`).

        With ``control="continuous"``: (B, 1, 3) float32 from -1 to 1: push ahead, push left, turn
        left. 1 does what the action forward, left or turn left does; numbers beyond are clipped.

    Reward:
        1 for touching the object to find, which draws the next one among the others. To touch
        another has no effect.

    Episode end:
        Truncated after ``limit`` steps. Never terminal.

    Metrics:
        ``found``: objects found in the episode.

    Args:
        n_envs: number of environments, N.
        geometries: floor plans. Default: mazes of 9 x 9 cells, at most 512.
        seed: of textures, lights, spawns, objects, and of the mazes drawn by default.
        device: where the tensors are. Default: a GPU if there is one.
        objects: number of objects, in the colours red, green, blue, yellow, magenta, cyan, orange,
            violet.
        limit: steps after which an episode is truncated.
        walls: striped, in colours that tell places apart, or plain, all in one grey.
        res: rays per camera.
        subsample: rays per pixel; divides ``res``.
        fov: field of view of a camera, degrees.
        cameras: yaw of each camera, degrees; 0 looks ahead, 90 left.
        fps: steps per second of simulated time.
        control: discrete or continuous actions.
        resample: if True, each episode takes place in a randomly drawn maze. Otherwise an
            environment keeps its own.
        privileged: if True, worlds have ``privileged`` for a critic: ``goal`` (B, 1, 4), tens of
            metres to the object to find, ahead, to the left and in a straight line, and the
            fraction of the steps that is left; ``places`` (B, 1, 2 ``objects``), tens of metres
            ahead and to the left to each object.
    """

    n_agents = 1

    @checked
    def __init__(
        self,
        n_envs: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 128,
        geometries: Geometries | None = None,
        *,
        seed: int = 1,
        device: torch.device | str | None = None,
        objects: Annotated[int, Field(ge=2, le=len(modules.COLOURS))] = 3,
        limit: Annotated[int, Field(ge=1, le=10**6)] = 1000,
        walls: Literal["striped", "plain"] = "striped",
        res: Annotated[int, Field(ge=1, le=1024)] = 256,
        subsample: Annotated[int, Field(ge=1, le=32)] = 4,
        fov: Annotated[float, Field(gt=0, lt=180)] = 130.0,
        cameras: Annotated[Sequence[float], Field(min_length=1, max_length=16)] = (0.0,),
        fps: Annotated[float, Field(ge=1, le=1000)] = 10.0,
        control: Literal["discrete", "continuous"] = "discrete",
        resample: bool = False,
        privileged: bool = False,
    ):
        if geometries is None:
            geometries = sources.sample("memory_maze", min(n_envs, 512), seed=seed)
        geometries = geometries if resample else spread(geometries, n_envs)
        mazes = scenery(geometries, n_agents=1, n_envs=n_envs, seed=seed, device=device)
        if walls == "plain":
            mazes.layouts.textures.vals.fill_(PLAIN)
        self.core = Core(mazes, res, fov, fps, cameras, seed)
        self.n_envs, self.device, self.fps = n_envs, self.core.device, self.core.fps
        self.subsample, self.limit = subsample, limit
        self.seed = seed + (6 << 32)  # not the spawns'
        self.spawner = modules.RandomSpawns(geometries, self.core, resample=resample)
        self.movement = modules.MomentumMovement(self.core, control=control)
        discs = {"object": modules.Disc(objects, RADIUS)}
        self.objects = modules.Objects(geometries, self.core, discs, n_points=1)
        self.objects.all.colours.copy_(torch.arange(objects))
        apart = 2 * (self.core.agents.radius + RADIUS + REACH)  # so that no two are touched at once
        points = arrangements(geometries, N_ARRANGEMENTS, objects, RADIUS, apart, self.seed)
        self.arrangements = torch.from_numpy(points).to(self.device)
        self.obs_space = dotdict(
            rgb=modules.RGB(self.core, subsample).space,
            d=modules.Depth(self.core, subsample).space,
            imu=spaces.MultiVector(1, 3),
            cue=spaces.MultiVector(1, 3, low=0, high=1),
        )
        self.action_space = self.movement.space
        self.privileged_space = (
            dotdict(goal=spaces.MultiVector(1, N_GOAL), places=spaces.MultiVector(1, 2 * objects))
            if privileged
            else None
        )
        engine.fit(n_envs, 8 * self.obs_space.d.H * self.obs_space.d.W + 64, self.device)
        self.cue, self.found, self.n_draws, self.ages = (
            torch.zeros(n_envs, dtype=torch.int32, device=self.device) for _ in range(4)
        )
        self.ended = torch.zeros(n_envs, dtype=torch.bool, device=self.device)
        self._resets = engine.Resets()

    def _begin(self, mask) -> arrdict:
        self.ended.copy_(mask)
        return self._world()

    def desync(self) -> None:
        """Gives every lane a random age, from the seed, so that episodes do not end together."""
        limits = torch.full_like(self.ages, self.limit)
        self.ages.copy_(modules.random_ages(limits, self.core.seed))

    def step(self, decision: Mapping) -> arrdict:
        """Takes one step by ``decision["actions"]``. Returns a world."""
        self.movement(decision)
        return self._resets.keep(self._world())

    def _world(self) -> arrdict:
        """Respawns agents whose episode has ended, computes rewards and flags, and renders."""
        self.spawner(self.ended)
        step = memory_step(
            self.core.scenery,
            self.core.agents,
            self.arrangements,
            self.cue,
            self.found,
            self.n_draws,
            self.ages,
            self.ended,
            seed=self.seed,
            limit=self.limit,
            reach=REACH,
            privileged=self.privileged_space is not None,
        )
        world = arrdict(
            obs=arrdict(self._view(), cue=step.cue_obs),
            reward=step.reward,
            reset=step.reset,
            terminal=step.terminal,
            truncated=step.truncated,
            metrics=arrdict(found=step.metrics),
        )
        if step.goal is not None:
            world["privileged"] = arrdict(goal=step.goal, places=step.places)
        return world

    def _view(self) -> arrdict:
        """Returns the observation without the cue."""
        view = engine.observe(self.core.scenery, self.core.agents, self.subsample, imu=True)
        return arrdict(images(view), imu=view.imu)

    def state(self, e: int = 0) -> arrdict:
        """Returns environment ``e`` for :meth:`plot_state`."""
        return arrdict(
            self._view().map(lambda leaf: leaf[e]),
            core=self.core.state(e),
            age=self.ages[e].clone(),
            found=self.found[e].clone(),
            cue=self.cue[e].clone(),
            goal=self.objects.all.positions[e, self.cue[e].long()].clone(),
        )

    @classmethod
    def plot_state(cls, state: arrdict) -> "Figure":
        """Draws a numpyified :meth:`state` as a matplotlib figure: the maze with the object to find
        in a ring, and the agent's RGB and depth.
        """
        colour = [*modules.COLOURS][int(state.cue)]
        title = f"step {state.age} · {state.found} found · to find: {colour}"
        yaws = state.core.yaws
        figure, plan, strips = plotting.panels(2, title=title, n_cameras=len(yaws))
        plotting.plot_goal(plan, state.goal, 1.5 * RADIUS)
        Core.plot_state(state.core, plan)
        modules.RGB.plot_state(state.rgb, strips[:1], yaws)
        modules.Depth.plot_state(state.d, strips[1:], yaws)
        return figure
