"""A curriculum: which homes new episodes take place in. Scores of homes come from the episodes that
train, and the environment draws homes by them.

T time, B lanes, D layouts. Nothing synchronises but `stats`. Sums are of integers (fixed point), so
that runs repeat bit for bit. With several ranks, each has scores of its own episodes.
"""

from collections.abc import Sequence
from typing import Annotated

import torch
from pydantic import Field, SkipValidation

from megastep.agents.storage.rollout import Rollout
from megastep.agents.types import Learner, StateDict
from megastep.settings import checked
from megastep.types import Env, optional

#: The metrics whose sum, cut to [0, 1], is the outcome of an episode: those of the first row that
#: an environment has. In Deathmatch a duel is decided if somebody was killed.
OUTCOMES = ("success",), ("coverage",), ("kills", "deaths")
_ONE = 2**20  # in fixed point
_TOTAL = 2**30  # of the weights
_UNSEEN = 0.25  # score of a home without an episode, the largest possible one
_SAVED = "n_episodes", "means", "squares", "scores", "cumulative"


class SFL:
    """Sampling for learnability (Rutherford et al. 2024): the score of a home is the variance of
    the outcomes of its episodes. A class of your own has the four methods below. Raises ValueError:
    the environment has no two homes to draw, or no metric tells the outcome.

    Of a success with probability p that is the paper's learnability p (1 - p), most where half of
    the episodes succeed. The paper rolls homes out apart; here the episodes that train tell. An
    unseen home has the largest score, 1/4.

    Args:
        env: environment that draws a layout for each episode.
        learner: not used.
        rollout: the rollout that `update` will get. Its layouts are allocated.
        sources: the name of each layout's source, for `stats`. Default: none are reported.
        uniform: fraction of draws that are uniform over all homes.
        temperature: homes are drawn in proportion to score^(1 / temperature).
        lr: how far a home's running means move towards the outcome of one episode.
        every: updates between two changes of the probabilities.

    Attributes:
        cumulative: (D,) int32, cumulative weights by which the environment draws.
        n_episodes: (D,) int64, episodes that ended in each home.
        means, squares: (D,) float32, running means of outcomes and of their squares, 0 before the
            first.
        scores: (D,) float32, of each home; the larger, the more often it is drawn.
    """

    @checked
    def __init__(
        self,
        env: SkipValidation[Env],
        learner: SkipValidation[Learner],
        rollout: SkipValidation[Rollout],
        sources: SkipValidation[Sequence[str]] | None = None,
        *,
        uniform: Annotated[float, Field(ge=0, le=1)] = 0.5,
        temperature: Annotated[float, Field(ge=0.01, le=1000)] = 1.0,
        lr: Annotated[float, Field(gt=0, le=1)] = 0.05,
        every: Annotated[int, Field(ge=1, le=1_000_000)] = 1,
    ):
        weigh = optional(env, "weigh_layouts")
        if weigh is None or optional(env, "layout") is None:
            raise ValueError(f"{type(env).__name__} has no homes to draw; use curriculum=none")
        self.cumulative = weigh()
        n, device = len(self.cumulative), self.cumulative.device
        if n < 2:
            raise ValueError("there is one home only, so none to draw; use curriculum=none")
        if outcomes_of(rollout) is None:
            raise ValueError(
                f"{type(env).__name__} has none of the metrics that tell the outcome of an episode "
                "(success; coverage; kills and deaths); use curriculum=none"
            )
        rollout.allocate_layouts()
        self.uniform, self.temperature, self.lr, self.every = uniform, temperature, lr, every
        self.n_updates = 0
        self.n_episodes = torch.zeros(n, dtype=torch.int64, device=device)
        self.means, self.squares = (torch.zeros(n, device=device) for _ in range(2))
        self.scores = torch.full((n,), _UNSEEN, device=device)
        sources = sources or ()
        self.sources = {
            name: torch.tensor([name == source for source in sources], device=device)
            for name in dict.fromkeys(sources)
        }

    @torch.no_grad()
    def update(self, rollout: Rollout) -> None:
        """Learns from the episodes that ended in a rollout, and changes the probabilities."""
        ended = (rollout.terminal | rollout.truncated) & rollout.learns[:-1]
        assert rollout.layouts is not None
        homes = rollout.layouts.flatten().long()
        n = self._sums(homes, ended)
        self.n_episodes += n
        outcomes = outcomes_of(rollout)
        assert outcomes is not None
        # towards the mean of n episodes; to their mean at first
        rates = torch.where(self.n_episodes > n, 1 - (1 - self.lr) ** n, (n > 0).float())
        for running, values in ((self.means, outcomes), (self.squares, outcomes.square())):
            sums = self._sums(homes, (values * _ONE).round().long() * ended)
            running += rates * (sums / (n.clamp(min=1) * _ONE) - running)
        variance = (self.squares - self.means.square()).clamp(min=0.0)
        self.scores.copy_(torch.where(self.n_episodes > 0, variance, _UNSEEN))
        self.n_updates += 1
        if self.n_updates % self.every == 0:
            powers = self.scores ** (1 / self.temperature)
            total = powers.sum()
            by_score = torch.where(total > 0, powers / total, 1 / len(powers))
            probabilities = self.uniform / len(powers) + (1 - self.uniform) * by_score
            weights = (probabilities * _TOTAL).long()
            self.cumulative.copy_(weights.cumsum(0).clamp_(max=2**31 - 1))

    def _sums(self, homes, values) -> torch.Tensor:
        """Returns the sums of values (T, B) by home, (D,) int64."""
        return torch.zeros_like(self.n_episodes).index_add_(0, homes, values.flatten().long())

    def stats(self) -> dict[str, float]:
        """Returns numbers for a report. Synchronises.

        Metrics:
            curriculum/effective_homes: exponential of the entropy of the draws: the number of homes
                if draws are uniform, 1 if one home is always drawn.
            curriculum/unseen: fraction of homes in which no episode has ended yet.
            curriculum/fewest_episodes: episodes that ended in the home with the fewest.
            curriculum/score: mean score; with `sfl`, mean learnability.
            curriculum/outcome: mean running outcome, all homes weighted alike; 0 in an unseen home.
            curriculum/worst: the same over the worst 5 % of homes.
            curriculum/outcome/SOURCE: with `geometry=mixed`, mean running outcome in the homes of a
                source.
            curriculum/drawn/SOURCE: with `geometry=mixed`, fraction of draws in those homes.
        """
        weights = self.cumulative.double().diff(prepend=self.cumulative.new_zeros(1).double())
        drawn = weights / weights.sum()
        worst = self.means.topk(-(-len(self.means) // 20), largest=False).values
        numbers = {
            "effective_homes": torch.special.entr(drawn).sum().exp(),
            "unseen": (self.n_episodes == 0).double().mean(),
            "fewest_episodes": self.n_episodes.min().double(),
            "score": self.scores.double().mean(),
            "outcome": self.means.double().mean(),
            "worst": worst.double().mean(),
        }
        for name, members in self.sources.items():
            mean = (self.means.double() * members).sum() / members.sum()
            numbers |= {f"outcome/{name}": mean, f"drawn/{name}": (drawn * members).sum()}
        values = torch.stack([*numbers.values()]).tolist()
        return {f"curriculum/{name}": value for name, value in zip(numbers, values)}

    def state_dict(self) -> StateDict:
        """Returns everything that changes; tensors are copies."""
        state = {name: getattr(self, name).clone() for name in _SAVED}
        return state | {"n_updates": self.n_updates}

    def load_state_dict(self, state: StateDict) -> None:
        """Continues from a `state_dict`."""
        for name in _SAVED:
            getattr(self, name).copy_(state[name])
        self.n_updates = state["n_updates"]


def outcomes_of(rollout: Rollout) -> torch.Tensor | None:
    """Returns the outcome of the episodes that end, (T, B) from 0 to 1; None if no metric tells."""
    for names in OUTCOMES:
        if all(name in rollout.metrics for name in names):
            total = torch.as_tensor(sum(rollout.metrics[name] for name in names))
            return total.nan_to_num(0.0).clamp(0.0, 1.0)
    return None
