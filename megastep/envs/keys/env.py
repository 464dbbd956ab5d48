"""Keys: open the doors of a home to reach a goal. N environments of one agent, so B = N lanes."""

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
from megastep.envs.keys.episodes import cached_episodes
from megastep.envs.keys.step import keys_step
from megastep.modules.objects import REACH
from megastep.scene import scenery, spread
from megastep.settings import MAX_ENVS, checked
from megastep.types import Geometries

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Keys"]

METRICS = "success", "doors", "wasted"
RADIUS = 0.15  # metres, of keys and the goal
N_EPISODES = 32  # per layout
MAX_DOORS = 6
LOCKED = "606060"  # doors without a key
GOAL = "violet"


class Keys(SceneryEnv):
    """An agent picks up keys and opens doors of their colours, to reach a goal in the last room.

    Each doorway of a home is open, or has a shut door: of a colour, whose key lies about, or grey,
    which stays locked. Every episode can be solved.

    Observation:
        A dict of float16, for each of C cameras (1) W = ``res / subsample`` pixels (64).

        - ``rgb``: (B, 1, 3, C, W), linear light. A pixel is the mean of ``subsample`` rays.
        - ``d``: (B, 1, 1, C, W), depth: 1 at the agent's edge, 0 at 10 m and beyond.
        - ``imu``: (B, 1, 3), angular velocity / 360 deg/s, velocity forward and left / 10 m/s.
        - ``keys``: (B, 1, ``doors``), 1 for each key that the agent carries: red, green, blue,
          yellow, magenta, cyan.

    Actions:
        (B, 1) integers: 0 nothing, 1 left, 2 right, 3 forward, 4 back, 5 turn left, 6 turn right.
        They accelerate the agent (:class:`~megastep.modules.MomentumMovement`). An agent picks up a
        key by touching it, and opens a door by touching it with its key, which is used up.

        With ``control="continuous"``: (B, 1, 3) float32 from -1 to 1: push ahead, push left, turn
        left. 1 does what the action forward, left or turn left does; numbers beyond are clipped.

    Reward:
        1 for touching the goal, a violet disc, ``key_reward`` for each key and ``door_reward`` for
        each door.

    Episode end:
        Terminal at the goal (success). Truncated after ``limit`` steps.

    Metrics:
        ``success``: 1 if the goal was reached.
        ``doors``: doors opened.
        ``wasted``: keys picked up and not used.

    Args:
        n_envs: number of environments, N.
        geometries: floor plans with doorways. Default: generated homes, at most 512.
        seed: of textures, lights, episodes, and of the homes drawn by default.
        device: where the tensors are. Default: a GPU if there is one.
        doors: shut doors with a key, at most; a home with fewer parts has fewer.
        limit: steps after which an episode is truncated.
        key_reward: reward for a key that is picked up.
        door_reward: reward for a door that is opened.
        res: rays per camera.
        subsample: rays per pixel; divides ``res``.
        fov: field of view of a camera, degrees.
        cameras: yaw of each camera, degrees; 0 looks ahead, 90 left.
        fps: steps per second of simulated time.
        control: discrete or continuous actions.
        resample: if True, each episode takes place in a randomly drawn home. Otherwise an
            environment keeps its own.
        privileged: if True, worlds have ``privileged.places`` (B, 1, 2 ``doors`` + 3) for a critic:
            tens of metres ahead and to the left to each key that lies about and to the goal, and
            the fraction of the steps that is left.
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
        doors: Annotated[int, Field(ge=1, le=MAX_DOORS)] = 3,
        limit: Annotated[int, Field(ge=1, le=10**6)] = 1000,
        key_reward: Annotated[float, Field(ge=0, le=1000)] = 0.1,
        door_reward: Annotated[float, Field(ge=0, le=1000)] = 0.3,
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
            geometries = sources.sample("homes", min(n_envs, 512), seed=seed)
        geometries = geometries if resample else spread(geometries, n_envs)
        self.seed = seed + (7 << 32)  # not the spawns'
        tables = cached_episodes(geometries, N_EPISODES, doors, self.seed)
        homes = scenery(geometries, n_agents=1, n_envs=n_envs, seed=seed, device=device)
        self.core = Core(homes, res, fov, fps, cameras, seed)
        self.n_envs, self.device, self.fps = n_envs, self.core.device, self.core.fps
        self.subsample = subsample
        self.rules: dict = dict(limit=limit, key_reward=key_reward, door_reward=door_reward)
        self.spawner = modules.RandomSpawns(geometries, self.core, resample=resample)
        self.movement = modules.MomentumMovement(self.core, control=control)
        kinds = {
            "key": modules.Disc(doors, RADIUS),
            "goal": modules.Disc(1, RADIUS),
            "door": modules.Door(),
        }
        colours = [*modules.COLOURS][:doors]
        self.objects = modules.Objects(
            geometries, self.core, kinds, [*colours, LOCKED, GOAL], n_points=1
        )
        self.tables: dict = {
            name: torch.from_numpy(table).to(self.device)
            for name, table in tables._asdict().items()
        }
        self.tables["doorways"] = self.objects["door"].poses
        self.obs_space = dotdict(
            rgb=modules.RGB(self.core, subsample).space,
            d=modules.Depth(self.core, subsample).space,
            imu=spaces.MultiVector(1, 3),
            keys=spaces.MultiVector(1, doors, low=0, high=1),
        )
        self.action_space = self.movement.space
        self.privileged_space = (
            dotdict(places=spaces.MultiVector(1, 2 * doors + 3)) if privileged else None
        )
        engine.fit(n_envs, 8 * self.obs_space.d.H * self.obs_space.d.W + 64, self.device)
        self.opened, self.n_draws, self.ages = (
            torch.zeros(n_envs, dtype=torch.int32, device=self.device) for _ in range(3)
        )
        self.ended = torch.zeros(n_envs, dtype=torch.bool, device=self.device)
        self._resets = engine.Resets()

    def _begin(self, mask) -> arrdict:
        self.ended.copy_(mask)
        # which keys keep from when they were carried; a seed gives the same episodes each time
        self.objects.all.angles.masked_fill_(mask[:, None], 0.0)
        return self._world()

    def desync(self) -> None:
        """Gives every lane a random age, from the seed, so that episodes do not end together."""
        limits = torch.full_like(self.ages, self.rules["limit"])
        self.ages.copy_(modules.random_ages(limits, self.core.seed))

    def step(self, decision: Mapping) -> arrdict:
        """Takes one step by ``decision["actions"]``. Returns a world."""
        self.movement(decision)
        return self._resets.keep(self._world())

    def _world(self) -> arrdict:
        """Respawns agents whose episode has ended, computes rewards and flags, and renders."""
        self.spawner(self.ended)
        step = keys_step(
            self.core.scenery,
            self.core.agents,
            **self.tables,
            opened=self.opened,
            n_draws=self.n_draws,
            ages=self.ages,
            ended=self.ended,
            seed=self.seed,
            reach=REACH,
            privileged=self.privileged_space is not None,
            **self.rules,
        )
        world = arrdict(
            obs=arrdict(self._view(), keys=step.keys_obs),
            reward=step.reward,
            reset=step.reset,
            terminal=step.terminal,
            truncated=step.truncated,
            metrics=arrdict(zip(METRICS, step.metrics.unbind())),
        )
        if step.privileged is not None:
            world["privileged"] = arrdict(places=step.privileged)
        return world

    def _view(self) -> arrdict:
        """Returns the observation without the keys."""
        view = engine.observe(self.core.scenery, self.core.agents, self.subsample, imu=True)
        return arrdict(images(view), imu=view.imu)

    def state(self, e: int = 0) -> arrdict:
        """Returns environment ``e`` for :meth:`plot_state`."""
        keys = self.objects["key"]
        return arrdict(
            self._view().map(lambda leaf: leaf[e]),
            core=self.core.state(e),
            age=self.ages[e].clone(),
            opened=self.opened[e].clone(),
            carried=keys.carried()[e, 0].clone(),
            goal=self.objects["goal"].positions[e, 0].clone(),
        )

    @classmethod
    def plot_state(cls, state: arrdict) -> "Figure":
        """Draws a numpyified :meth:`state` as a matplotlib figure: the home with shut doors, keys
        and the goal in a ring, and the agent's RGB and depth.
        """
        carried = [name for name, has in zip(modules.COLOURS, state.carried) if has]
        doors = "door" if state.opened == 1 else "doors"
        title = f"step {state.age} · {state.opened} {doors} opened"
        title += f" · carries {', '.join(carried)}" if carried else ""
        yaws = state.core.yaws
        figure, plan, strips = plotting.panels(2, title=title, n_cameras=len(yaws))
        plotting.plot_goal(plan, state.goal, 1.5 * RADIUS)
        Core.plot_state(state.core, plan)
        modules.RGB.plot_state(state.rgb, strips[:1], yaws)
        modules.Depth.plot_state(state.d, strips[1:], yaws)
        return figure
