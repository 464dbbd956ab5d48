"""Memory: find coloured objects in a maze, again and again. A step is one operation,
:func:`memory_step`.

N environments of one agent, D layouts, M arrangements per layout, O objects.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np
import torch
from pydantic import Field

from megastep import geometry, modules, spaces
from megastep.arrdict import arrdict
from megastep.dotdict import dotdict
from megastep.engine import checks
from megastep.engine.agents import Agents, check_on_cpu
from megastep.engine.launch_params import lanes_of, object_params, seed_params, world_params
from megastep.engine.scenery import Scenery
from megastep.envs.common import world_of
from megastep.envs.first_person import FirstPerson, images
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import launch
from megastep.modules.lifecycle import derived_seed
from megastep.modules.objects import REACH
from megastep.modules.spawning import CLEARANCE, candidates, distances
from megastep.settings import checked

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Memory", "MemoryStep", "memory_step"]

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
N_GOAL = LIBRARY.constants["N_GOAL"]  # numbers that a critic sees of the object to find
RADIUS = 0.2  # metres, of objects
N_ARRANGEMENTS = 64  # of objects, per layout
N_POINTS = 512  # drawn per layout, for arrangements
ROUNDS = 20  # of drawing arrangements; then the search ends
PLAIN = 0.4  # linear light, the grey of walls of one colour


class MemoryStep(NamedTuple):
    """The outcome of a step, one row per environment."""

    reward: torch.Tensor  # (N,) 1 where the object to find was touched, else 0
    reset: torch.Tensor  # (N,) bool
    terminal: torch.Tensor  # (N,) bool, always False
    truncated: torch.Tensor  # (N,) bool
    metrics: torch.Tensor  # (N,) objects found where an episode ends
    cue_obs: torch.Tensor  # (N, 1, 3) fp16, linear light: the colour of the object to find
    # for a critic, None if not wanted: (N, 1, 4) tens of metres to the object to find, ahead, to
    # the left and in a straight line; fraction of the steps that is left
    goal: torch.Tensor | None
    places: torch.Tensor | None  # (N, 1, 2 O) tens of metres ahead and to the left to each object


def memory_step(
    scenery: Scenery,
    agents: Agents,
    arrangements: torch.Tensor,
    cue: torch.Tensor,
    found: torch.Tensor,
    n_draws: torch.Tensor,
    ages: torch.Tensor,
    ended: torch.Tensor,
    *,
    seed: int = 1,
    limit: int = 1000,
    reach: float = 0.05,
    privileged: bool = False,
) -> MemoryStep:
    """Rewards each agent that touches the object to find, and draws the next among the others.
    Where an episode starts, puts objects where a random arrangement has them. Call it before the
    environment is rendered. See :class:`~megastep.envs.Memory`.

    Args:
        scenery: with two objects or more.
        arrangements: (D, M, O, 2) float32 metres, where objects may lie.
        cue: (N,) int32, the object to find, updated in place as all that follow.
        found: (N,) int32, objects found in this episode.
        n_draws: (N,) int32, numbers drawn so far, the generator's counter.
        ages: (N,) int32, steps since the first observation.
        ended: (N,) bool. In: environments that start an episode in this step. Out: those whose
            episode ends in this step.
        seed: the generator's key.
        limit: steps after which an episode is truncated.
        reach: metres between surfaces at which an agent touches an object.
        privileged: compute the privileged observation.

    Raises:
        TypeError, ValueError: naming the argument that does not fit.
        EngineError: on the CPU, if a position is NaN or an object to find does not exist.
    """
    n, _ = lanes_of(scenery, agents)
    checks.integer("agents per environment", scenery.n_agents, 1, 1)
    objects, device = scenery.objects, scenery.device
    n_objects = checks.integer("objects", objects.n_objects if objects is not None else 0, 2)
    n_arrangements = checks.length("arrangements", arrangements, axis=1)
    goal = places = None
    if checks.flag("privileged", privileged):
        goal = torch.empty((n, 1, N_GOAL), device=device)
        places = torch.empty((n, 1, 2 * n_objects), device=device)
    flags = [torch.empty(n, dtype=torch.bool, device=device) for _ in range(3)]
    reward, metrics = (torch.empty(n, device=device) for _ in range(2))
    cue_obs = torch.empty((n, 1, 3), dtype=torch.float16, device=device)
    outputs = dict(metrics=metrics, cue_obs=cue_obs, goal=goal, places=places)
    out = MemoryStep(reward, *flags, **outputs)
    counters = dict(cue=cue, found=found, n_draws=n_draws, ages=ages)
    shape = len(scenery.layouts), n_arrangements, n_objects, 2
    launch(
        *(LIBRARY, "memory_step", device, n),
        **world_params(scenery, agents, "positions", "angles"),
        objects=object_params(scenery),
        arrangements=checks.address("arrangements", arrangements, shape, torch.float32, device),
        **checks.addresses((n,), torch.int32, device, **counters),
        ended=checks.address("ended", ended, (n,), torch.bool, device),
        **out._asdict(),
        **seed_params(seed),
        n_arrangements=checks.integer("the number of arrangements", n_arrangements, 1),
        limit=checks.integer("limit", limit, 1, 2**31 - 1),
        reach=checks.number("reach", reach, 0, checks.LIMIT, "metres"),
    )
    check_on_cpu(agents)
    return out


def arrangements(
    geometries: Sequence[dotdict], n: int, n_objects: int, radius: float, apart: float, seed: int
) -> np.ndarray:
    """Returns random points for objects, (D, n, n_objects, 2) float32 metres, each in a room of its
    own if there are as many. If fewer arrangements are found, some are repeated.

    Args:
        geometries: floor plans. The same object may occur several times.
        n: arrangements per layout.
        n_objects: points of each.
        radius: metres; discs of it around the points are 5 cm clear of walls.
        apart: metres between two points, at least.
        seed: of the points.

    Raises:
        ValueError: naming a geometry where the objects do not fit.
    """
    distinct = {id(g): g for g in geometries}
    found = {
        key: _arrangements(g, n, n_objects, radius, apart, np.random.Generator(bits))
        for (key, g), bits in zip(
            distinct.items(), (np.random.Philox([seed, d]) for d in range(len(distinct)))
        )
    }
    return np.stack([found[id(g)] for g in geometries]).astype(np.float32)


def _arrangements(g, n, n_objects, radius, apart, random) -> np.ndarray:
    points = next(candidates(g, N_POINTS, random))
    points = points[distances(points, g.walls) > radius + CLEARANCE]
    numbers = g.masks[tuple(geometry.indices(points, g.masks.shape, g.res).T)]
    order = numbers.argsort(kind="stable")
    _, starts, counts = np.unique(numbers[order], return_index=True, return_counts=True)
    kept = np.empty((0, n_objects, 2))
    for _ in range(ROUNDS if len(points) else 0):
        rooms = random.random((n, len(counts))).argsort(1)
        rooms = rooms[:, np.arange(n_objects) % len(counts)]
        index = starts[rooms] + (random.random(rooms.shape) * counts[rooms]).astype(int)
        drawn = points[order[index]]
        away = np.linalg.norm(drawn[:, :, None] - drawn[:, None], axis=-1)
        away[:, np.arange(n_objects), np.arange(n_objects)] = np.inf
        kept = np.concatenate([kept, drawn[away.min((1, 2)) >= apart]])[:n]
        if len(kept) == n:
            return kept
    if not len(kept):
        raise ValueError(
            f"geometry {g.id} has no room for {n_objects} objects, {apart:.2f} m apart: take fewer "
            "objects or larger homes"
        )
    return np.resize(kept, (n, n_objects, 2))


class Memory(FirstPerson):
    """Memory Maze's task (Pasukonis et al. 2022): find the object of a colour, then the next.

    Objects of distinct colours lie in a maze, each in a room of its own if there are as many rooms.
    Maze and objects stay the same for an episode. So an agent that remembers where it saw each
    finds them faster.

    Observation:
        ``rgb``, ``d`` and ``imu`` of :class:`~megastep.envs.first_person.FirstPerson`, and float16
        ``cue``: (B, 1, 3), linear light, the colour of the object to find, as ``rgb`` shows it.

    Actions:
        Those of :class:`~megastep.envs.first_person.FirstPerson`.

    Reward:
        1 for touching the object to find, which draws the next one among the others. To touch
        another has no effect.

    Episode end:
        Truncated after ``limit`` steps. Never terminal.

    Metrics:
        ``found``: objects found in the episode.

    Args:
        objects: number of objects, in the colours red, green, blue, yellow, magenta, cyan, orange,
            violet.
        limit: steps after which an episode is truncated.
        walls: striped, in colours that tell places apart, or plain, all in one grey.
        privileged: if True, worlds have ``privileged`` for a critic: ``goal`` (B, 1, 4), tens of
            metres to the object to find, ahead, to the left and in a straight line, and the
            fraction of the steps that is left; ``places`` (B, 1, 2 ``objects``), tens of metres
            ahead and to the left to each object.
    """

    source = "memory_maze"

    @checked
    def __init__(
        self,
        *shared: Any,
        objects: Annotated[int, Field(ge=2, le=len(modules.COLOURS))] = 3,
        limit: Annotated[int, Field(ge=1, le=10**6)] = 1000,
        walls: Literal["striped", "plain"] = "striped",
        privileged: bool = False,
        **options: Any,
    ):
        self.n_objects, self.limit = objects, limit
        super().__init__(*shared, **options)
        if walls == "plain":
            self.core.scenery.layouts.textures.vals.fill_(PLAIN)
        self.obs_space["cue"] = spaces.MultiVector(1, 3, low=0, high=1)
        if privileged:
            self.privileged_space = dotdict(
                goal=spaces.MultiVector(1, N_GOAL), places=spaces.MultiVector(1, 2 * objects)
            )
        self.cue, self.found, self.n_draws = (self._integers() for _ in range(3))

    def _furnish(self, geometries, resample) -> modules.RandomSpawns:
        self.seed = derived_seed(self.core.seed, "memory")
        discs = {"object": modules.Disc(self.n_objects, RADIUS)}
        self.objects = modules.Objects(geometries, self.core, discs, n_points=1)
        self.objects.all.colours.copy_(torch.arange(self.n_objects))
        apart = 2 * (self.core.agents.radius + RADIUS + REACH)  # so that no two are touched at once
        size = N_ARRANGEMENTS, self.n_objects, RADIUS, apart
        points = arrangements(geometries, *size, self.seed)
        self.arrangements = torch.from_numpy(points).to(self.device)
        return super()._furnish(geometries, resample)

    def _world(self, free=None) -> arrdict:
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
        world = world_of(
            step, arrdict(images(self._view()), cue=step.cue_obs), arrdict(found=step.metrics)
        )
        if step.goal is not None:
            world["privileged"] = arrdict(goal=step.goal, places=step.places)
        return world

    def state(self, e: int = 0) -> arrdict:
        """Returns environment ``e`` for :meth:`plot_state`."""
        return arrdict(
            self._seen_by(e),
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
        return cls._draw(state, title, (state.goal, 1.5 * RADIUS))
