"""Members that the environments share."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, cast

import torch

from megastep import engine
from megastep.arrdict import arrdict, numpyify
from megastep.core import Core
from megastep.devices import threads
from megastep.engine import checks
from megastep.engine.launch_params import POSE, launch_in, seed_params
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import launch
from megastep.modules import RandomSpawns
from megastep.schedules import Number, Scheduled
from megastep.types import Env

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["BoardEnv", "DisplayedEnv", "SceneryEnv", "Weight", "judged", "step_outputs", "world_of"]

FLAGS = "reset", "terminal", "truncated"

#: Weight of a part of a reward, a number or a schedule.
Weight = Annotated[Number, Scheduled(ge=0, le=1000)]


def step_outputs(env: Any, n_metrics: int, obs: Mapping, critic: Mapping) -> dict[str, Any]:
    """Returns empty tensors for what the kernel of a game's step writes: ``reward``, the flags,
    ``metrics`` (n_metrics, B), and (B, 1, size) of each {name: size} that policies observe, in
    float16, or a critic, in float32. None where a size is 0.
    """
    n, device = env.n_envs * env.n_agents, env.device
    flags = {name: torch.empty(n, dtype=torch.bool, device=device) for name in FLAGS}
    metrics = torch.empty((n_metrics, n), device=device) if n_metrics else None
    outputs = dict(reward=torch.empty(n, device=device), **flags, metrics=metrics)
    for sizes, dtype in ((obs, torch.float16), (critic, torch.float32)):
        for name, size in sizes.items():
            empty = torch.empty((n, 1, size), dtype=dtype, device=device) if size else None
            outputs[name] = empty
    return outputs


def judged(
    env: Any,
    library: KernelLibrary,
    operation: str,
    n_metrics: int,
    obs: Mapping,
    critic: Mapping,
    n_threads: int | None = None,
    **fields: Any,
) -> dict[str, Any]:
    """Launches the kernel of the step of a game in scenery, by default with a thread per lane.
    Returns its :func:`step_outputs`; those of a critic are None unless ``env.privileged_space``.
    """
    core, resets, n_lanes = env.core, env._resets, env.n_envs * env.n_agents
    critic = dict.fromkeys(critic, 0) if env.privileged_space is None else critic
    if resets.mask is None:
        resets.parts["outputs"] = step_outputs(env, n_metrics, obs, critic)
    outputs = resets.parts["outputs"]
    launch_in(
        *(core.scenery, core.agents, operation, n_threads or n_lanes, *POSE),
        library=library,
        ages=env.ages,
        ended=env.ended,
        only=resets.mask,
        **outputs,
        **fields,
    )
    return outputs


def world_of(outputs: Mapping, obs: Any, metrics: Sequence[str], **critic: str) -> arrdict:
    """Returns the world of a step's outputs, names of its metrics, and a critic's inputs."""
    world = arrdict(obs=obs, **{name: outputs[name] for name in ("reward", *FLAGS)})
    if outputs["metrics"] is not None:
        world["metrics"] = arrdict(zip(metrics, outputs["metrics"].unbind()))
    if critic and outputs[next(iter(critic.values()))] is not None:
        world["privileged"] = arrdict({name: outputs[key] for name, key in critic.items()})
    return world


class DisplayedEnv:
    """An environment that is drawn by its own ``state(e)`` and ``plot_state(state)``, and begins
    episodes by its own ``_begin(mask)``.
    """

    _begin: Callable[[torch.Tensor], arrdict]
    _resets: engine.Resets
    plot_state: Callable[..., "Figure"]
    state: Callable[..., arrdict]

    def reset(
        self, seed: int | torch.Tensor | None = None, mask: torch.Tensor | None = None
    ) -> arrdict:
        """Starts a new episode in every lane, or in those of a mask. Returns the first world.

        Args:
            seed: of the episodes from now on, from 0 to 2**63 - 1, or a seed per lane, (B,) int64.
            mask: (B,) bool, lanes that begin. The others keep state and observation, unless their
                game begins anew with a lane of the mask, as in Pong. Returns the last world, with
                new rows in place.
        """
        in_place = getattr(self, "_begin_in_place", lambda mask: False)
        return self._resets(cast(Env, self), self._begin, seed, mask, in_place)

    def display(self, e: int = 0) -> "Figure":
        """Draws environment ``e`` as it is now. Returns a matplotlib figure."""
        return self.plot_state(numpyify(self.state(e)))


class BoardEnv(DisplayedEnv):
    """A game on a board, of which one kernel plays a step. A subclass has ``_world(actions)``."""

    n_envs: int
    n_agents: int
    device: torch.device
    seed: int
    #: Rows of ``games`` that count draws, and say whose episode has ended.
    draws_row: int
    ended_row: int
    _world: Callable[[torch.Tensor], arrdict]

    def _allocate(self, n_fields: int, *lanes_last: str) -> None:
        """Makes ``games``, (n_fields, N) int32."""
        on: dict = dict(device=self.device)
        self.games = torch.zeros((n_fields, self.n_envs), dtype=torch.int32, **on)
        self.error_flag = torch.zeros(1, dtype=torch.int32, **on)
        self.no_actions = torch.zeros((self.n_envs * self.n_agents, 1), dtype=torch.int64, **on)
        self._resets = engine.Resets(("games", *lanes_last), draws={"games": self.draws_row})

    def _begin(self, mask: torch.Tensor) -> arrdict:
        self.games[self.ended_row].copy_(mask.view(self.n_envs, -1).any(1))
        return self._world(self.no_actions)

    def step(self, decision: Mapping) -> arrdict:
        """Takes one step with ``decision.actions`` (B, 1). Returns a world."""
        actions = checks.alike("actions", decision["actions"], self.no_actions)
        return self._resets.keep(self._world(actions))

    def _play(
        self,
        library: KernelLibrary,
        operation: str,
        actions: torch.Tensor,
        outputs: Mapping,
        **fields: Any,
    ) -> None:
        """Launches the kernel of a step, which writes :func:`step_outputs`."""
        launch(
            *(library, operation, self.device, self.n_envs),
            games=self.games,
            actions=actions.contiguous(),
            **outputs,
            error_flag=self.error_flag,
            **seed_params(self.seed),
            n_envs=self.n_envs,
            n_threads=threads(),
            **fields,
        )
        if self.device.type == "cpu":
            self.check()

    def check(self) -> None:
        """Raises EngineError if the engine flagged an error on the device since the last check.

        Synchronises host and device, so do not call it from ``step``.
        """
        engine.check_flag(self.error_flag)


class SceneryEnv(DisplayedEnv):
    """An environment built around a :class:`~megastep.core.Core`, its attribute ``core``."""

    core: Core
    spawner: RandomSpawns

    def check(self) -> None:
        """Raises EngineError if an error was flagged on the device, for which it waits."""
        engine.check(self.core.agents)

    @property
    def layout(self) -> torch.Tensor:
        """(N,) int32: the layout that each environment shows now, an index into ``geometries``."""
        return self.core.scenery.layout

    def weigh_layouts(self) -> torch.Tensor:
        """Has the layouts of new episodes be drawn by weights from now on, first by equal ones.
        Returns the cumulative weights, (D,) int32, to be changed in place. ValueError if
        environments keep their layouts.
        """
        return self.spawner.weigh_layouts()
