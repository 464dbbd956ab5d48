"""Keys: open the doors of a home to reach a goal."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import torch
from pydantic import Field

from megastep import modules, spaces
from megastep.arrdict import arrdict
from megastep.coefficients import Coefficients
from megastep.dotdict import dotdict
from megastep.engine.launch_params import object_params, seed_params
from megastep.envs.common import Weight, judged, world_of
from megastep.envs.first_person import FirstPerson, images
from megastep.envs.keys.episodes import episodes
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.modules.kinds import REACH
from megastep.modules.lifecycle import derived_seed
from megastep.settings import checked

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Keys"]

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
METRICS = "success", "doors", "wasted"
RADIUS = 0.15  # metres, of keys and the goal
N_EPISODES = 32  # per layout
MAX_DOORS = 6
LOCKED = "606060"  # doors without a key
GOAL = "violet"


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

    begins_in_place = True

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
        self.opened, self.n_draws = torch.zeros_like(self.ages), torch.zeros_like(self.ages)

    def _furnish(self, geometries, resample) -> modules.RandomSpawns:
        self.seed = derived_seed(self.core.seed, "keys")
        tables = episodes(geometries, N_EPISODES, self.n_colours, self.seed)
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
        self.spawner(self._begins)
        out = self._judge()
        obs = arrdict(images(self._view()), keys=out["keys_obs"])
        return world_of(out, obs, METRICS, places="privileged")

    def _judge(self) -> dict:
        """Has agents pick up keys, open doors and reach goals, before anything is rendered."""
        n_colours = self.n_colours
        return judged(
            *(self, LIBRARY, "keys_step", len(METRICS)),
            *(dict(keys_obs=n_colours), dict(privileged=2 * n_colours + 3)),
            objects=object_params(self.core.scenery),
            **self.tables,
            opened=self.opened,
            n_draws=self.n_draws,
            **seed_params(self.seed),
            n_episodes=N_EPISODES,
            n_colours=n_colours,
            n_doorways=len(self.objects["door"]),
            limit=self.limit,
            reach=REACH,
            **self.weights.tensors,
        )

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
        """Draws a numpyified :meth:`state`: shut doors, keys, the goal in a ring, RGB and depth."""
        carried = [name for name, has in zip(modules.COLOURS, state.carried) if has]
        doors = "door" if state.opened == 1 else "doors"
        title = f"step {state.age} · {state.opened} {doors} opened"
        title += f" · carries {', '.join(carried)}" if carried else ""
        return cls._draw(state, title, (state.goal, 1.5 * RADIUS))
