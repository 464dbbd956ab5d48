"""The lifecycle of episodes: when each lane begins and ends one. N environments, A agents, B = N A
lanes.
"""

import torch

from megastep import engine
from megastep.arrdict import arrdict
from megastep.core import Core
from megastep.engine import checks

ENDLESS = 2**31 - 1  # steps; the largest int32, which ages and limits are
#: What draws by seeds derived from that of an environment.
STREAMS = "spawns", "lifespans", "pointgoal", "ages", "points", "objects", "memory", "keys"
STREAMS += ("hideandseek",)


def derived_seed(seed: int, stream: str) -> int:
    """Returns the seed of one of an environment's random streams, named in ``STREAMS``."""
    return seed + (STREAMS.index(stream) << 32)


class CounterGenerator:
    """A counter-based random generator (Philox) with a counter per lane: the k-th draw of a lane
    depends on the seed, from 0 to 2**64 - 1, the lane and k only. So it is the same on the CPU, on
    a GPU and in a CUDA graph.
    """

    def __init__(self, n_lanes: int, seed: int, device: torch.device | str):
        n_lanes = checks.integer("n_lanes", n_lanes, 0, ENDLESS)
        self.seed = checks.integer("seed", seed, 0, 2**64 - 1)
        self.counts = torch.zeros(n_lanes, dtype=torch.int32, device=device)
        self.values = torch.zeros((n_lanes, 4), device=device)

    def __call__(self, mask: torch.Tensor) -> torch.Tensor:
        """Draws four uniform numbers in [0, 1), (B, 4) float32, for each lane where ``mask``, (B,)
        bool, is True. The other lanes keep those of their last draw.
        """
        checks.length("mask", mask)
        return engine.uniform(self.counts, mask.reshape(-1), self.seed, self.values)


def random_ages(limits: torch.Tensor, seed: int) -> torch.Tensor:
    """Returns ages (B,) int32 at which lanes could be in the middle of an episode that is truncated
    at an age of ``limits`` (B,) int32: uniform in [0, limit), and 0 where that is ``ENDLESS``.
    """
    counts, everywhere = torch.zeros_like(limits), torch.ones_like(limits, dtype=torch.bool)
    numbers = torch.zeros((len(limits), 4), device=limits.device)
    uniform = engine.uniform(counts, everywhere, derived_seed(seed, "ages"), numbers)[:, 0]
    ages = (uniform.double() * limits).int()  # in double precision it stays below the limit
    return ages.masked_fill_(limits == ENDLESS, 0)


class RandomLifespans:
    """Random time limits of episodes, from ``shortest`` to ``longest`` steps, for the argument
    ``limit`` of :class:`Lifecycle`. The seed is the core's by default.
    """

    def __init__(
        self, core: Core, shortest: int = 128, longest: int = 256, seed: int | None = None
    ):
        self.shortest = checks.integer("shortest", shortest, 1, ENDLESS)
        self.longest = checks.integer("longest", longest, 1, ENDLESS)
        if shortest > longest:
            raise ValueError(f"shortest={shortest} and longest={longest} leave no lifespan between")
        seed = core.seed if seed is None else checks.integer("seed", seed, 0)
        n_lanes, seed = core.n_envs * core.n_agents, derived_seed(seed, "lifespans")
        self.random = CounterGenerator(n_lanes, seed, core.device)

    def draw(self, reset: torch.Tensor, limits: torch.Tensor) -> None:
        """Writes new lifespans into ``limits``, (B,) int32, where ``reset``, (B,) bool, is True."""
        uniform = self.random(reset)[:, 0]
        limits.copy_(uniform * (self.longest - self.shortest + 1)).add_(self.shortest)


class Lifecycle:
    """Keeps the age of every lane's episode and sets ``reset``, ``terminal`` and ``truncated``.

    An episode is truncated when its age reaches its limit. The step after an episode's end begins
    the next one, whatever the decision says. A step that begins an episode cannot end it.

    Args:
        limit: number of steps, or :class:`RandomLifespans`. None sets no limit; the environment may
            write its own into ``limits``.

    Attributes:
        ages: (B,) int32, steps since the first observation of the episode.
        limits: (B,) int32, age at which the episode is truncated.
        ended: (B,) bool, True if the last world ended the episode.
    """

    def __init__(self, core: Core, limit: int | RandomLifespans | None = None):
        self.lifespans = limit if isinstance(limit, RandomLifespans) else None
        n_lanes, device = core.n_envs * core.n_agents, core.device
        self.n_agents, self.seed = core.n_agents, core.seed
        self.ages = torch.zeros(n_lanes, dtype=torch.int32, device=device)
        self.limits = torch.zeros_like(self.ages)
        if self.lifespans is None:
            self.limits.fill_(
                ENDLESS if limit is None else checks.integer("limit", limit, 1, ENDLESS)
            )
        self.ended = torch.zeros(n_lanes, dtype=torch.bool, device=device)
        self._never = torch.zeros_like(self.ended)

    def start_all(self) -> torch.Tensor:
        """Returns the ``reset`` mask, (B,) bool, of ``env.reset``."""
        return torch.ones_like(self.ended)

    def start_ended(self) -> torch.Tensor:
        """Returns the ``reset`` mask, (B,) bool, of a step: True where the last episode ended."""
        return self.ended.clone()

    def desync(self) -> None:
        """Gives every lane a random age, so that episodes do not end together, after a reset."""
        self.ages.copy_(random_ages(self.limits, self.seed))

    def __call__(self, reset: torch.Tensor, terminal: torch.Tensor | None = None) -> arrdict:
        """Counts one step. Returns the world's flags, arrdict(reset, terminal, truncated), of lanes
        that begin an episode, ``reset`` (B,) bool, and those whose episode ends by the game's rule,
        ``terminal``. That is ignored where ``reset``, and goes before the time limit.
        """
        checks.alike("reset", reset, self.ended)
        if terminal is not None:
            checks.alike("terminal", terminal, self.ended)
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
        """Returns ``age`` and ``limit`` of the agents of environment ``e``: (A,) int32, steps."""
        lanes = slice(e * self.n_agents, (e + 1) * self.n_agents)
        return arrdict(age=self.ages[lanes].clone(), limit=self.limits[lanes].clone())
