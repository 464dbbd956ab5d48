"""What films show: a moment per step of each environment, with what happened before it."""

from __future__ import annotations

import collections
import itertools
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from megastep import plotting
from megastep.arrdict import clone, numpyify
from megastep.types import Tree, n_lanes, optional

if TYPE_CHECKING:
    from megastep.types import World

MAX_RETURNS = 4  # of as many agents, one by one


class Moment(NamedTuple):
    """A frame to be: a numpyified state, and the return so far."""

    state: Tree
    note: str


def film_moments(players, steps, greedy, seed, trail) -> Iterator[list]:
    """The moments of all players, until the last of them is at the end."""
    by_env = collections.defaultdict(list)
    for player in players:
        by_env[id(player.env)].append(player)
    streams = {}
    for same in by_env.values():
        for player, worlds in zip(same, itertools.tee(_worlds(same[0], greedy, seed), len(same))):
            streams[id(player)] = _moments_of(player, worlds, steps, trail)
        del worlds  # which would keep those that a player at the end does not take
    latest = [None] * len(players)
    for moments in itertools.zip_longest(*(streams.pop(id(player)) for player in players)):
        latest = [new or old for new, old in zip(moments, latest, strict=True)]
        yield latest


def _worlds(player, greedy, seed) -> Iterator[World]:
    env, policy = player.env, player.policy
    world, hidden = env.reset(), policy.initial(n_lanes(env), env.device)
    generator = torch.Generator(env.device).manual_seed(seed)
    while True:
        yield world
        decision, hidden = policy(world, hidden, sample=not greedy, generator=generator)
        world = env.step(decision)


def _moments_of(player, worlds, steps, trail) -> Iterator[Moment]:
    env: Any = player.env
    n_agents, past = optional(env, "n_agents"), _Past(trail)
    e, agent = divmod(player.lane, n_agents)
    lanes = slice(e * n_agents, (e + 1) * n_agents)
    returns = np.zeros(n_agents, np.float32)
    for world in itertools.islice(worlds, player.steps or steps):
        rewards, starts = (
            world[key][lanes].cpu().numpy().reshape(n_agents) for key in ("reward", "reset")
        )
        returns = np.where(starts, np.float32(0), returns + rewards)
        state = past(numpyify(clone(env.state(e))), starts)
        yield Moment(state, _returns(returns))
    if player.expected is not None and not np.isclose(returns[agent], player.expected, rtol=1e-4):
        raise ValueError(
            f"its return is {returns[agent]:.6g} and not {player.expected:.6g}: film it on the "
            "device that it was evaluated on (device=); or the environment has changed since, or "
            "draws what no seed decides"
        )


def _returns(returns) -> str:
    if len(returns) > MAX_RETURNS:
        return f"mean return {returns.mean():.1f}"
    return "return " + ", ".join(f"{round(float(x), 1) + 0.0:.1f}" for x in returns)


class _Past:
    """Adds to states, where ``state["core"]`` is a core's, where agents were in this episode and
    what they saw: see :meth:`megastep.core.Core.state`.

    Args:
        trail: number of steps.
    """

    def __init__(self, trail: int):
        self._trail, self._views, self._n_views = collections.deque(maxlen=trail + 1), None, 0

    def __call__(self, state: Tree, starts: np.ndarray) -> Any:
        """Returns the state; ``starts`` (A,) says whose episodes begin."""
        core = state.get("core") if isinstance(state, dict) else None
        if not isinstance(core, dict) or "distances" not in core:
            return state
        for positions in self._trail:
            positions[starts] = np.nan
        self._trail.append(np.array(core["positions"], float))
        core["trail"] = np.stack(self._trail)
        views = [
            [
                plotting.view_polygon(position, angle + yaw, core["fov"], distances)
                for yaw, distances in zip(core["yaws"], of_agent, strict=True)
            ]
            for position, angle, of_agent in zip(
                core["positions"], core["angles"], core["distances"], strict=True
            )
        ]
        core["views"] = self._with(np.array(views, np.float32), starts.all())
        return state

    def _with(self, views, is_start) -> np.ndarray:
        """Returns the views of this episode, the last included: part of an array that grows."""
        self._n_views = 0 if is_start else self._n_views
        if self._views is None or is_start:
            self._views = np.empty((64, *views.shape), np.float32)
        if self._n_views == len(self._views):
            self._views = np.concatenate([self._views, np.empty_like(self._views)])
        self._views[self._n_views] = views
        self._n_views += 1
        return self._views[: self._n_views]
