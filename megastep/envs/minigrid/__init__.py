"""MiniGrid's tasks, equal to minigrid 3.2 step for step. N environments, a lane each."""

import difflib
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import torch
from pydantic import Field

from megastep import engine, plotting, spaces
from megastep.arrdict import arrdict
from megastep.envs.common import BoardEnv, step_outputs, world_of
from megastep.envs.minigrid.drawing import draw
from megastep.envs.minigrid.tasks import LIBRARY, TASKS, Task
from megastep.imports import import_object
from megastep.settings import MAX_ENVS, checked

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["MiniGrid"]

VIEW, N_MISSION = LIBRARY.constants["VIEW"], LIBRARY.constants["N_MISSION"]
GAME_FIELDS = LIBRARY.constants["GAME_FIELDS"]
Rooms = Annotated[int, Field(ge=1, le=LIBRARY.constants["MAX_ROOMS"])]
MAX_SIZE = 128  # cells along a side of a custom grid


class MiniGrid(BoardEnv):
    """The grid worlds of MiniGrid (Chevalier-Boisvert et al. 2023), with the layouts, dynamics,
    rewards and limits of minigrid 3.2, or grids of one's own.

    Observation:
        ``image`` (N, 1, 3, 7, 7) uint8: kind, colour and state of each cell that the agent sees, as
        the original's ``image`` with the channel first and rows before columns. ``direction``
        (N, 1) integers: 0 right, 1 down, 2 left, 3 up. ``mission`` (N, 1, 18) float32, in tasks
        whose mission differs between episodes: one-hot colour and kind (key, ball, box) of what the
        mission names, and of its second object.

    Actions:
        (N, 1) integers: 0 turn left, 1 turn right, 2 forward, 3 pick up, 4 drop, 5 toggle, 6 done;
        only the first three in Dynamic-Obstacles.

    Reward:
        1 - 0.9 t / limit for success at step t; -1 for a collision in Dynamic-Obstacles.

    Episode end:
        Terminal at success, in lava, and where the task says so. Truncated at the task's limit.

    Metrics:
        ``success``: 1 if the episode ended with success.

    Args:
        n_envs: number of environments.
        id: task, by its id in Gymnasium's registry.
        rooms: fewest and most rooms of MultiRoom, which each episode draws from; the limit is 20
            steps for each of the most. None: as the id says.
        layouts: import path of a function that draws grids in place of a task's; see docs/grids.md.
        limit: steps of an episode in such grids.
        seed: of the layouts and of what moves.
        device: default: a GPU if there is one.
    """

    fps = 10.0
    controls = {"ArrowLeft": 0, "ArrowRight": 1, "ArrowUp": 2, "p": 3, "d": 4, " ": 5, "Enter": 6}
    n_agents = 1
    draws_row, ended_row = 5, 6

    @checked
    def __init__(
        self,
        n_envs: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 128,
        *,
        id: str = "MiniGrid-DoorKey-8x8-v0",
        rooms: tuple[Rooms, Rooms] | None = None,
        layouts: str | None = None,
        limit: Annotated[int, Field(ge=1, le=10**6)] = 1000,
        seed: int = 1,
        device: torch.device | str | None = None,
    ):
        self.n_envs, self.seed = n_envs, seed
        self.device = engine.device("auto" if device is None else device)
        self.layouts = self.starts = None
        if layouts is None:
            self.task = task_of(id) if rooms is None else with_rooms(task_of(id), *rooms)
        else:
            cells, starts = custom(import_object(layouts), seed)
            self.layouts, self.starts = cells.to(self.device), starts.to(self.device)
            n, height, width = cells.shape
            self.task = Task(LIBRARY.constants["CUSTOM"], width, height, limit, a=n)
        self.action_space = spaces.MultiDiscrete(1, self.task.n_actions)
        self.obs_space = {
            "image": spaces.MultiImage(1, 3, VIEW, VIEW, dtype=torch.uint8, low=0, high=(9, 5, 2)),
            "direction": spaces.MultiDiscrete(1, 4),
        }
        if self.task.has_mission:
            self.obs_space["mission"] = spaces.MultiVector(
                1, N_MISSION, dtype=torch.float32, low=0.0, high=1.0
            )
        shape = n_envs, self.task.height, self.task.width
        engine.fit(n_envs, 512 + shape[1] * shape[2], self.device)
        self.cells = torch.zeros(shape, dtype=torch.uint8, device=self.device)
        self._allocate(GAME_FIELDS)

    def _world(self, actions) -> arrdict:
        n, task = self.n_envs, self.task
        outputs = step_outputs(self, 1, {}, dict(mission=N_MISSION * task.has_mission))
        image = torch.empty((n, 1, 3, VIEW, VIEW), dtype=torch.uint8, device=self.device)
        obs = arrdict(image=image, direction=torch.empty_like(actions))
        if task.has_mission:
            obs["mission"] = outputs["mission"]
        self._play(
            *(LIBRARY, "minigrid_step", actions, outputs),
            cells=self.cells,
            image=image,
            direction=obs["direction"],
            layouts=self.layouts,
            starts=self.starts,
            **task._asdict(),
        )
        return world_of(outputs, obs, ["success"])

    def state(self, e: int = 0) -> arrdict:
        """Returns environment ``e`` for :meth:`plot_state`.

        ``cells`` (H, W) uint8: kinds plus 16 times colours; ``agent`` (3,): x, y and direction;
        ``carried``: a cell, or 0; ``age`` in steps.
        """
        game, cells = self.games[:, e].clone(), self.cells[e].clone()
        return arrdict(cells=cells, agent=game[:3], carried=game[3], age=game[4])

    @classmethod
    def plot_state(cls, state: arrdict) -> "Figure":
        """Draws the grid and the agent of a numpyified :meth:`state` as a matplotlib figure."""
        figure, plan, _ = plotting.panels(title=f"step {state.age}")
        draw(plan, state.cells, state.agent, int(state.carried))
        return figure


def task_of(id: str) -> Task:
    """Returns the task of an id. ValueError names the nearest ids if there is none."""
    if id not in TASKS:
        near = difflib.get_close_matches(id, TASKS, 3, 0.3) or [*TASKS][:3]
        raise ValueError(
            f"id: {id!r} is not among MiniGrid's tasks here; near are {', '.join(near)}"
        )
    return TASKS[id]


def with_rooms(task: Task, fewest: int, most: int) -> Task:
    """Returns a task of MultiRoom with so many rooms. ValueError if it is another task."""
    if task.task != LIBRARY.constants["MULTI_ROOM"] or fewest > most:
        raise ValueError(
            f"rooms: {[fewest, most]} must be the fewest and the most rooms of a MultiRoom task"
        )
    return task._replace(a=fewest, b=most, limit=20 * most)


def custom(
    layouts: Callable[[int], tuple[torch.Tensor, torch.Tensor]], seed: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns what a function draws: D grids, of which each episode gets a random one, (D, H, W)
    uint8, and the agents' starts in them, (D, 3) int32: x, y and direction. Raises ValueError: they
    have other shapes, unknown kinds, or a start that is no empty cell.

    Args:
        layouts: called with a seed. A cell is a kind, such as ``tasks.LIBRARY.constants["WALL"]``,
            plus 16 times a colour.
    """
    cells, starts = (torch.as_tensor(part) for part in layouts(seed))
    cells, starts = cells.to("cpu", torch.uint8), starts.to("cpu", torch.int32)
    if cells.ndim != 3 or starts.shape != (len(cells), 3) or max(cells.shape[1:]) > MAX_SIZE:
        raise ValueError(
            f"layouts: must return cells (D, H, W), at most {MAX_SIZE} a side, and starts (D, 3), "
            f"not {tuple(cells.shape)} and {tuple(starts.shape)}"
        )
    height, width = cells.shape[1:]
    x, y = starts[:, 0].long(), starts[:, 1].long()
    are_inside = (x > 0) & (x < width - 1) & (y > 0) & (y < height - 1)
    here = cells[torch.arange(len(cells)), y.clamp(0, height - 1), x.clamp(0, width - 1)]
    wrong = ~are_inside | (here != LIBRARY.constants["EMPTY"])
    wrong |= ((cells & 15 < 1) | (cells & 15 > 11) | (cells >> 4 > 5)).flatten(1).any(1)
    if wrong.any():
        raise ValueError(
            f"layouts: grid {int(wrong.nonzero()[0])} has a cell that is no kind plus 16 times a "
            "colour, or its agent does not start in an empty cell inside of it"
        )
    return cells, starts
