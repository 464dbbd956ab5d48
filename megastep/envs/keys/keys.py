"""Keys: open the doors of a home to reach a goal. A step is one operation, :func:`keys_step`.

N environments of one agent, D layouts, M episodes per layout, C colours, K doorways.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import torch
from pydantic import Field

from megastep import modules, spaces
from megastep.arrdict import arrdict
from megastep.coefficients import Coefficients
from megastep.dotdict import dotdict
from megastep.engine import checks
from megastep.engine.agents import Agents, check_on_cpu
from megastep.engine.launch_params import lanes_of, object_params, seed_params, world_params
from megastep.engine.scenery import Scenery
from megastep.envs.common import Weight, world_of
from megastep.envs.first_person import FirstPerson, images
from megastep.envs.keys.episodes import cached_episodes
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import launch
from megastep.modules.lifecycle import derived_seed
from megastep.modules.objects import REACH
from megastep.settings import checked

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Keys", "KeysStep", "keys_step"]

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
METRICS = "success", "doors", "wasted"
RADIUS = 0.15  # metres, of keys and the goal
N_EPISODES = 32  # per layout
MAX_DOORS = 6
LOCKED = "606060"  # doors without a key
GOAL = "violet"


class KeysStep(NamedTuple):
    """The outcome of a step, one row per environment."""

    reward: torch.Tensor  # (N,)
    reset: torch.Tensor  # (N,) bool
    terminal: torch.Tensor  # (N,) bool
    truncated: torch.Tensor  # (N,) bool
    metrics: torch.Tensor  # (3, N): success, doors opened, keys wasted, where an episode ends
    keys_obs: torch.Tensor  # (N, 1, C) fp16: 1 for each key that the agent carries
    privileged: torch.Tensor | None  # (N, 1, 2 C + 3) for a critic: tens of metres ahead and to the
    # left to each key that lies about and to the goal; fraction of the steps that is left


def keys_step(
    scenery: Scenery,
    agents: Agents,
    starts: torch.Tensor,
    keys: torch.Tensor,
    goals: torch.Tensor,
    doors: torch.Tensor,
    doorways: torch.Tensor,
    opened: torch.Tensor,
    n_draws: torch.Tensor,
    ages: torch.Tensor,
    ended: torch.Tensor,
    *,
    seed: int = 1,
    limit: int = 1000,
    reach: float = 0.05,
    key_reward: float | torch.Tensor = 0.0,
    door_reward: float | torch.Tensor = 0.0,
    privileged: bool = False,
) -> KeysStep:
    """Has each agent pick up the keys and open the doors that it touches, and ends its episode at
    the goal. Where an episode starts, puts agent and objects where a random one of the layout's
    episodes has them. Call it before the environment is rendered. See
    :class:`~megastep.envs.Keys`.

    Args:
        scenery: whose objects are C keys, the goal, and K doors.
        starts: (D, M, 2) float32 metres, where agents begin.
        keys: (D, M, C, 2) float32 metres, NaN of a key that there is not.
        goals: (D, M, 2) float32 metres.
        doors: (D, M, K) int32: -1 for no door, the colour of a door, or C for one that stays
            locked.
        doorways: (D, K, 4) float32: x and y in metres, angle in degrees, half the length in metres.
        opened: (N,) int32, doors opened in this episode, updated in place as all that follow.
        n_draws: (N,) int32, numbers drawn so far, the generator's counter.
        ages: (N,) int32, steps since the first observation.
        ended: (N,) bool. In: environments that start an episode in this step. Out: those whose
            episode ends in this step.
        seed: the generator's key.
        limit: steps after which an episode is truncated.
        reach: metres between surfaces at which an agent touches an object.
        key_reward: for a key that is picked up; a number, or a tensor () on the device.
        door_reward: for a door that is opened, likewise.
        privileged: compute the privileged observation.

    Raises:
        TypeError, ValueError: naming the argument that does not fit.
        EngineError: on the CPU, if a position is NaN.
    """
    n, _ = lanes_of(scenery, agents)
    checks.integer("agents per environment", scenery.n_agents, 1, 1)
    device, d, m = scenery.device, len(scenery.layouts), checks.length("starts", starts, axis=1)
    n_colours, n_doorways = checks.length("keys", keys, 2), checks.length("doors", doors, 2)
    objects = scenery.objects
    n_objects = objects.n_objects if objects is not None else 0
    checks.integer("objects", n_objects, n_colours + 1 + n_doorways, n_colours + 1 + n_doorways)
    privileged_out = None
    if checks.flag("privileged", privileged):
        privileged_out = torch.empty((n, 1, 2 * n_colours + 3), device=device)
    flags = [torch.empty(n, dtype=torch.bool, device=device) for _ in range(3)]
    metrics = torch.empty((len(METRICS), n), device=device)
    keys_obs = torch.empty((n, 1, n_colours), dtype=torch.float16, device=device)
    outputs = dict(metrics=metrics, keys_obs=keys_obs, privileged=privileged_out)
    out = KeysStep(torch.empty(n, device=device), *flags, **outputs)
    f32 = torch.float32, device
    counters = dict(opened=opened, n_draws=n_draws, ages=ages)
    launch(
        *(LIBRARY, "keys_step", device, n),
        **world_params(scenery, agents, "positions", "angles"),
        objects=object_params(scenery),
        **checks.addresses((d, m, 2), *f32, starts=starts, goals=goals),
        keys=checks.address("keys", keys, (d, m, n_colours, 2), *f32),
        doorways=checks.address("doorways", doorways, (d, n_doorways, 4), *f32),
        doors=checks.address("doors", doors, (d, m, n_doorways), torch.int32, device),
        **checks.addresses((n,), torch.int32, device, **counters),
        ended=checks.address("ended", ended, (n,), torch.bool, device),
        **out._asdict(),
        **seed_params(seed),
        n_episodes=m,
        n_colours=n_colours,
        n_doorways=n_doorways,
        limit=checks.integer("limit", limit, 1, 2**31 - 1),
        reach=checks.number("reach", reach, 0, checks.LIMIT, "metres"),
        key_reward=checks.weight("key_reward", key_reward, device),
        door_reward=checks.weight("door_reward", door_reward, device),
    )
    check_on_cpu(agents)
    return out


class Keys(FirstPerson):
    """An agent picks up keys and opens doors of their colours, to reach a goal in the last room.

    Each doorway of a home is open, or has a shut door: of a colour, whose key lies about, or grey,
    which stays locked. Every episode can be solved.

    Observation:
        ``rgb``, ``d`` and ``imu`` of :class:`~megastep.envs.first_person.FirstPerson`, and float16
        ``keys``: (B, 1, ``doors``), 1 for each key that the agent carries: red, green, blue,
        yellow, magenta, cyan.

    Actions:
        Those of :class:`~megastep.envs.first_person.FirstPerson`. An agent picks up a key by
        touching it, and opens a door by touching it with its key, which is used up.

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
        geometries: floor plans with doorways. Default: generated homes, at most 512.
        doors: shut doors with a key, at most; a home with fewer parts has fewer.
        limit: steps after which an episode is truncated.
        key_reward: reward for a key that is picked up, a number or a schedule.
        door_reward: reward for a door that is opened, likewise.
        privileged: if True, worlds have ``privileged.places`` (B, 1, 2 ``doors`` + 3) for a critic:
            tens of metres ahead and to the left to each key that lies about and to the goal, and
            the fraction of the steps that is left.
    """

    @checked
    def __init__(
        self,
        *shared: Any,
        doors: Annotated[int, Field(ge=1, le=MAX_DOORS)] = 3,
        limit: Annotated[int, Field(ge=1, le=10**6)] = 1000,
        key_reward: Weight = 0.1,
        door_reward: Weight = 0.3,
        privileged: bool = False,
        **options: Any,
    ):
        self.n_colours, self.limit = doors, limit
        super().__init__(*shared, **options)
        self.weights = Coefficients(self.device, key_reward=key_reward, door_reward=door_reward)
        self.coefficients = (self.weights,)
        self.obs_space["keys"] = spaces.MultiVector(1, doors, low=0, high=1)
        if privileged:
            self.privileged_space = dotdict(places=spaces.MultiVector(1, 2 * doors + 3))
        self.opened, self.n_draws = self._integers(), self._integers()

    def _furnish(self, geometries, resample) -> modules.RandomSpawns:
        self.seed = derived_seed(self.core.seed, "keys")
        tables = cached_episodes(geometries, N_EPISODES, self.n_colours, self.seed)
        discs = modules.Disc(self.n_colours, RADIUS), modules.Disc(1, RADIUS)
        kinds = {"key": discs[0], "goal": discs[1], "door": modules.Door()}
        colours = [*[*modules.COLOURS][: self.n_colours], LOCKED, GOAL]
        self.objects = modules.Objects(geometries, self.core, kinds, colours, n_points=1)
        self.tables: dict = {
            name: torch.from_numpy(table).to(self.core.device)
            for name, table in tables._asdict().items()
        }
        self.tables["doorways"] = self.objects["door"].poses
        return super()._furnish(geometries, resample)

    def _begin(self, mask) -> arrdict:
        # which keys keep from when they were carried; a seed gives the same episodes each time
        self.objects.all.angles.masked_fill_(mask[:, None], 0.0)
        return super()._begin(mask)

    def _world(self, free=None) -> arrdict:
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
            limit=self.limit,
            privileged=self.privileged_space is not None,
            **self.weights.tensors,
        )
        world = world_of(
            step,
            arrdict(images(self._view()), keys=step.keys_obs),
            arrdict(zip(METRICS, step.metrics.unbind())),
        )
        if step.privileged is not None:
            world["privileged"] = arrdict(places=step.privileged)
        return world

    def state(self, e: int = 0) -> arrdict:
        """Returns environment ``e`` for :meth:`plot_state`."""
        keys = self.objects["key"]
        return arrdict(
            self._seen_by(e),
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
        return cls._draw(state, title, (state.goal, 1.5 * RADIUS))
