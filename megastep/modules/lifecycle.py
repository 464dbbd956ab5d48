"""When episodes begin and end: the part of the contract that every environment shares.

N environments, A agents, B = N A lanes.
"""

from typing import Any

import torch

from megastep import engine
from megastep.arrdict import arrdict

ENDLESS = 2**31 - 1  # steps; the longest an int32 age can tell


class CounterGenerator:
    """Random numbers by lane: the k-th draw of a lane depends on the seed, the lane and k alone, so
    it is the same on every device, captured or not.
    """

    def __init__(self, n_lanes: int, seed: int, device: torch.device | str):
        self.seed = seed
        self.counts = torch.zeros(n_lanes, dtype=torch.int32, device=device)
        self.values = torch.zeros((n_lanes, 4), device=device)

    def __call__(self, mask: torch.Tensor) -> torch.Tensor:
        """Four uniform numbers in [0, 1) for each lane, (B, 4): new where ``mask`` (B,) bool,
        elsewhere those drawn last.
        """
        return engine.uniform(self.counts, mask.reshape(-1), self.seed, self.values)


class RandomLifespans:
    """Lifespans of a random number of steps, from ``shortest`` to ``longest``: what a
    :class:`Lifecycle` may take for its limit.
    """

    def __init__(self, core: Any, shortest: int = 128, longest: int = 256, seed: int | None = None):
        if not 0 < shortest <= longest:
            raise ValueError(
                f"lifespans need 0 < shortest <= longest steps, but {shortest} and {longest} were "
                f"given"
            )
        self.shortest, self.longest = shortest, longest
        seed = (core.seed if seed is None else seed) + (1 << 32)  # other draws than the spawns'
        self.random = CounterGenerator(core.n_envs * core.n_agents, seed, core.device)

    def draw(self, reset: torch.Tensor, limits: torch.Tensor) -> None:
        """Writes lifespans into ``limits`` (B,) int32: new ones where ``reset`` (B,) bool."""
        chance = self.random(reset)[:, 0]
        limits.copy_(chance * (self.longest - self.shortest + 1)).add_(self.shortest)


class Lifecycle:
    """Which lanes begin an episode, which end theirs, and why: `reset`, `terminal` and `truncated`
    of a world.

    ``ages`` (B,) int32 are steps since the episode's first observation; an episode is truncated
    when its age reaches the lane's of ``limits`` (B,) int32. ``ended`` (B,) bool: the last world
    was its episode's last, so the next step begins another, whatever the decision says. A step that
    begins an episode cannot end it.

    Args: ``limit``: a number of steps, a :class:`RandomLifespans`, or None: episodes end by the
    environment's own rules, of which it may write some into ``limits``.
    """

    def __init__(self, core: Any, limit: int | RandomLifespans | None = None):
        fixed = ENDLESS if limit is None else limit
        self.lifespans = limit if isinstance(limit, RandomLifespans) else None
        if self.lifespans is None and not 1 <= fixed <= ENDLESS:
            raise ValueError(f"an episode's limit must be at least one step, but {limit} was given")
        lanes, device = core.n_envs * core.n_agents, core.device
        self.n_agents = core.n_agents
        self.ages = torch.zeros(lanes, dtype=torch.int32, device=device)
        self.limits = torch.zeros_like(self.ages)
        if self.lifespans is None:
            self.limits.fill_(fixed)
        self.ended = torch.zeros(lanes, dtype=torch.bool, device=device)
        self._never = torch.zeros_like(self.ended)

    def start_all(self) -> torch.Tensor:
        """(B,) bool: every lane begins an episode."""
        return torch.ones_like(self.ended)

    def start_ended(self) -> torch.Tensor:
        """(B,) bool: the lanes that begin an episode in this step, as their last one ended."""
        return self.ended.clone()

    def __call__(self, reset: torch.Tensor, terminal: torch.Tensor | None = None) -> arrdict:
        """Counts one step: lanes of ``reset`` (B,) bool begin an episode, the others age.

        ``terminal`` (B,) bool: which episodes end here by the environment's own rule. Returns the
        world's flags, arrdict(reset, terminal, truncated), each (B,) bool.
        """
        if self.lifespans is not None:
            self.lifespans.draw(reset, self.limits)
        self.ages.add_(1).masked_fill_(reset, 0)
        truncated = self.ages >= self.limits
        if terminal is None:
            self.ended.copy_(truncated)
            return arrdict(reset=reset, terminal=self._never, truncated=truncated)
        terminal = terminal & ~reset
        truncated &= ~terminal
        self.ended.copy_(terminal | truncated)
        return arrdict(reset=reset, terminal=terminal, truncated=truncated)

    def state(self, e: int = 0) -> arrdict:
        """Of environment ``e``'s agents, (A,) each: ``age`` and ``limit`` in steps."""
        lanes = slice(e * self.n_agents, (e + 1) * self.n_agents)
        return arrdict(age=self.ages[lanes].clone(), limit=self.limits[lanes].clone())
