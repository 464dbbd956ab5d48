"""Memory: find coloured objects in a maze, again and again."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field

from megastep import geometry, modules, spaces
from megastep.arrdict import arrdict
from megastep.dotdict import dotdict
from megastep.engine.launch_params import object_params, seed_params
from megastep.envs.common import judged, world_of
from megastep.envs.first_person import FirstPerson, images
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.modules.kinds import REACH
from megastep.modules.lifecycle import derived_seed
from megastep.modules.spawning import CLEARANCE, cached, candidates, distances, per_geometry
from megastep.settings import checked

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Memory"]

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
N_GOAL = LIBRARY.constants["N_GOAL"]  # numbers that a critic sees of the object to find
RADIUS = 0.2  # metres, of objects
N_ARRANGEMENTS = 64  # of objects, per layout
N_POINTS = 512  # drawn per layout, for arrangements
ROUNDS = 20  # of drawing arrangements; then the search ends
PLAIN = 0.4  # linear light, the grey of walls of one colour


def arrangements(
    geometries: Sequence[dotdict], n: int, n_objects: int, radius: float, apart: float, seed: int
) -> np.ndarray:
    """Returns random points for objects, (D, n, n_objects, 2) float32 metres, each in a room of its
    own if there are as many. If fewer of the n arrangements are found, some are repeated. Discs of
    ``radius`` around the points are 5 cm clear of walls, and any two points ``apart`` metres apart.
    ValueError naming a geometry where the objects do not fit.
    """
    arguments = n, n_objects, radius, apart

    def build() -> dict[str, np.ndarray]:
        draw = lambda g, random: _arrangements(g, *arguments, random)  # noqa: E731
        return dict(points=np.stack(per_geometry(geometries, seed, draw)).astype(np.float32))

    return cached("objects-", Path(__file__), geometries, (*arguments, seed), build)["points"]


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
    begins_in_place = True

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
        self.cue, self.found, self.n_draws = (torch.zeros_like(self.ages) for _ in range(3))

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
        self.spawner(self._begins)
        out = self._judge()
        obs = arrdict(images(self._view()), cue=out["cue_obs"])
        return world_of(out, obs, ["found"], goal="goal", places="places")

    def _judge(self) -> dict:
        """Rewards agents for objects that they touch, before anything is rendered."""
        return judged(
            *(self, LIBRARY, "memory_step", 1),
            *(dict(cue_obs=3), dict(goal=N_GOAL, places=2 * self.n_objects)),
            objects=object_params(self.core.scenery),
            arrangements=self.arrangements,
            cue=self.cue,
            found=self.found,
            n_draws=self.n_draws,
            **seed_params(self.seed),
            n_arrangements=N_ARRANGEMENTS,
            limit=self.limit,
            reach=REACH,
        )

    def truth(self) -> arrdict:
        """As of :class:`FirstPerson`; the target is the object to find."""
        cue = self.cue.long()[:, None, None].expand(-1, 1, 2)
        return self._with_target(super().truth(), self.objects.all.positions.gather(1, cue)[:, 0])

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
        """Draws a numpyified :meth:`state`: maze, the object to find in a ring, RGB and depth."""
        colour = [*modules.COLOURS][int(state.cue)]
        title = f"step {state.age} · {state.found} found · to find: {colour}"
        return cls._draw(state, title, (state.goal, 1.5 * RADIUS))
