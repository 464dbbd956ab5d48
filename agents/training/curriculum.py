"""Curricula: which homes new episodes take place in. Scores of homes come from the episodes that
train, and the environment draws homes by them.

T time, B lanes, D layouts. Everything stays on the device and nothing synchronises but `stats`.
Sums are of integers (fixed point), so that they do not depend on the order of addition and runs
repeat bit for bit. With several ranks, each has scores of its own episodes and draws by them.
"""

from collections.abc import Sequence
from typing import Annotated, Literal

import torch
from pydantic import Field, SkipValidation

from megastep.agents.algorithms import returns
from megastep.agents.storage.rollout import Rollout
from megastep.agents.types import Learner, LearnerOptions, StateDict, with_defaults
from megastep.settings import checked
from megastep.types import Env, optional

Fraction = Annotated[float, Field(ge=0, le=1)]
Rate = Annotated[float, Field(gt=0, le=1)]
Temperature = Annotated[float, Field(ge=0.01, le=1000)]
Updates = Annotated[int, Field(ge=1, le=1_000_000)]

#: The metrics whose sum, cut to [0, 1], is the outcome of an episode: those of the first row that
#: an environment has. In Deathmatch a duel is decided if somebody was killed.
OUTCOMES = ("success",), ("coverage",), ("kills", "deaths")
_ONE = 2**20  # in fixed point
_LARGEST = 1e4  # absolute advantage; larger ones count as this
_TOTAL = 2**30  # of the weights
_SAVED = "n_episodes", "means", "squares", "scores", "staleness", "cumulative"


class Curriculum:
    """Keeps running statistics of homes, and sets by them how often each is drawn.

    Args:
        env: environment that draws a layout for each episode.
        rollout: the rollout that `update` will get. Its layouts are allocated.
        sources: the name of each layout's source, for `stats`. Default: none are reported.
        lr: how far a home's running means move towards the outcome of one episode.
        every: updates between two changes of the probabilities.

    Attributes:
        cumulative: (D,) int32, cumulative weights by which the environment draws.
        n_episodes: (D,) int64, episodes that ended in each home.
        means, squares: (D,) float32, running means of outcomes and of their squares, 0 before the
            first.
        scores: (D,) float32, of each home; the larger, the more often it is drawn.
        staleness: (D,) int64, updates since an episode ended there.

    Raises:
        ValueError: the environment has no two homes to draw, or too little is known of episodes.
    """

    def __init__(
        self,
        env: Env,
        rollout: Rollout,
        sources: Sequence[str] | None,
        lr: float,
        every: int,
    ):
        weigh = optional(env, "weigh_layouts")
        if weigh is None or optional(env, "layout") is None:
            raise ValueError(f"{type(env).__name__} has no homes to draw; use curriculum=none")
        self.cumulative = weigh()
        n = len(self.cumulative)
        if n < 2:
            raise ValueError("there is one home only, so none to draw; use curriculum=none")
        rollout.allocate_layouts()
        device = self.cumulative.device
        self.lr, self.every, self.n_updates = lr, every, 0
        self.n_episodes, self.staleness = (
            torch.zeros(n, dtype=torch.int64, device=device) for _ in range(2)
        )
        self.means, self.squares, self.scores = (torch.zeros(n, device=device) for _ in range(3))
        self.lanes = torch.zeros(2, rollout.n_lanes, dtype=torch.int64, device=device)
        sources = sources or ()
        self.sources = {
            name: torch.tensor([name == source for source in sources], device=device)
            for name in dict.fromkeys(sources)
        }

    def probabilities(self) -> torch.Tensor:
        """Returns how likely each home is to be drawn, (D,) float32 of sum 1."""
        raise NotImplementedError

    def _rescore(self, rollout, n, homes, ended) -> None:
        """Updates `scores`, after the other statistics.

        Args:
            n: (D,) int64, the episodes that ended in each home.
            homes: (T * B,) int64, the layouts.
            ended: (T, B) bool, where an episode ended that counts.
        """
        raise NotImplementedError

    @torch.no_grad()
    def update(self, rollout: Rollout) -> None:
        """Learns from the episodes that ended in a rollout, and changes the probabilities."""
        ended = (rollout.terminal | rollout.truncated) & rollout.learns[:-1]
        assert rollout.layouts is not None
        homes = rollout.layouts.flatten().long()
        n = self._sums(homes, ended)
        self.n_episodes += n
        self.staleness.add_(1).masked_fill_(n > 0, 0)
        outcomes = outcomes_of(rollout)
        if outcomes is not None:
            for running, values in ((self.means, outcomes), (self.squares, outcomes.square())):
                self._average(running, n, self._sums(homes, fixed(values, 1.0) * ended))
        self._rescore(rollout, n, homes, ended)
        self.n_updates += 1
        if self.n_updates % self.every == 0:
            weights = (self.probabilities() * _TOTAL).long()
            self.cumulative.copy_(weights.cumsum(0).clamp_(max=2**31 - 1))

    def _sums(self, homes, values) -> torch.Tensor:
        """Returns the sums of values (T, B) by home, (D,) int64."""
        sums = torch.zeros_like(self.n_episodes)
        return sums.index_add_(0, homes, values.flatten().long())

    def _average(self, running, n, sums) -> None:
        """Moves a running mean by n episodes of these sums, (D,) each; to their mean at first."""
        is_known = self.n_episodes > n
        rates = torch.where(is_known, 1 - (1 - self.lr) ** n, (n > 0).float())
        running += rates * (sums / (n.clamp(min=1) * _ONE) - running)

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
        return state | {"lanes": self.lanes.clone(), "n_updates": self.n_updates}

    def load_state_dict(self, state: StateDict) -> None:
        """Continues from a `state_dict`. Its `lanes` are None if new episodes begin."""
        for name in _SAVED:
            getattr(self, name).copy_(state[name])
        self.n_updates = state["n_updates"]
        self.lanes.zero_() if state["lanes"] is None else self.lanes.copy_(state["lanes"])


class SFL(Curriculum):
    """Sampling for learnability (Rutherford et al. 2024): the score of a home is the variance of
    the outcomes of its episodes.

    Of a success with probability p that is the paper's learnability p (1 - p): 0 in homes that are
    always solved or never, most where half of the episodes succeed. Of a coverage c from 0 to 1 it
    is E[c^2] - E[c]^2. There c (1 - c) would only say how large the coverage is: a home of which
    every episode covers 80 % would look as learnable as a coin flip of p = 0.8, though its episodes
    differ in nothing that could be learnt from. For c of 0 or 1 both are the same.

    The paper samples from the most learnable of homes that it rolls out apart; here the episodes
    that train tell the learnability of all homes. An unseen home has the largest score, 1/4.

    Args:
        uniform: fraction of draws that are uniform over all homes.
        temperature: homes are drawn in proportion to score^(1 / temperature).
        lr: how far a home's running means move towards the outcome of one episode.
        every: updates between two changes of the probabilities.
    """

    @checked
    def __init__(
        self,
        env: SkipValidation[Env],
        learner: SkipValidation[Learner],
        rollout: SkipValidation[Rollout],
        sources: SkipValidation[Sequence[str]] | None = None,
        *,
        uniform: Fraction = 0.5,
        temperature: Temperature = 1.0,
        lr: Rate = 0.05,
        every: Updates = 1,
    ):
        super().__init__(env, rollout, sources, lr, every)
        self.uniform, self.temperature = uniform, temperature
        if outcomes_of(rollout) is None:
            raise ValueError(
                f"{type(env).__name__} has none of the metrics that tell the outcome of an episode "
                "(success; coverage; kills and deaths); use curriculum=plr or none"
            )
        self.scores.fill_(0.25)

    def probabilities(self) -> torch.Tensor:
        powers = self.scores ** (1 / self.temperature)
        return self.uniform / len(powers) + (1 - self.uniform) * proportions(powers)

    def _rescore(self, rollout, n, homes, ended) -> None:
        variance = (self.squares - self.means.square()).clamp(min=0.0)
        self.scores.copy_(torch.where(self.n_episodes > 0, variance, 0.25))


class PLR(Curriculum):
    """Prioritised level replay (Jiang et al. 2021): homes are drawn by the rank of their scores,
    mixed with how long ago an episode ended there.

    The score of an episode is the mean of |A|, or of max(A, 0), over its steps, with the
    generalised advantages A at the time of acting; that of a home is a running mean over episodes,
    as thousands may end there at once. Unseen homes rank first. The paper's temperature of 0.1
    draws almost only the home of the highest rank; with thousands of lanes the default is 1.

    Args:
        score: of an advantage: its absolute value, or its positive part.
        temperature: homes are drawn in proportion to rank^(-1 / temperature).
        staleness: fraction of draws in proportion to the updates since an episode ended in a home.
        lr: how far a home's running score moves towards that of one episode.
        every: updates between two changes of the probabilities.
    """

    @checked
    def __init__(
        self,
        env: SkipValidation[Env],
        learner: SkipValidation[Learner],
        rollout: SkipValidation[Rollout],
        sources: SkipValidation[Sequence[str]] | None = None,
        *,
        score: Literal["absolute", "positive"] = "absolute",
        temperature: Temperature = 1.0,
        staleness: Fraction = 0.1,
        lr: Rate = 0.05,
        every: Updates = 1,
    ):
        super().__init__(env, rollout, sources, lr, every)
        self.score, self.temperature, self.mix = score, temperature, staleness
        self.learner, options = learner, with_defaults(learner, LearnerOptions)
        if rollout.values is None or options.gamma is None or options.lambda_ is None:
            raise ValueError(
                "curriculum=plr needs values at the time of acting, which learner=ppo stores; use "
                "curriculum=sfl"
            )

    def probabilities(self) -> torch.Tensor:
        scores = torch.where(self.n_episodes > 0, self.scores, torch.inf)
        order = scores.argsort(descending=True, stable=True)
        ranks = torch.arange(1, len(order) + 1, dtype=torch.float32, device=order.device)
        powers = torch.empty_like(ranks).scatter_(0, order, ranks ** (-1 / self.temperature))
        return (1 - self.mix) * proportions(powers) + self.mix * proportions(self.staleness.float())

    def _rescore(self, rollout, n, homes, ended) -> None:
        steps = rollout.transitions()
        options = with_defaults(self.learner, LearnerOptions)
        assert options.gamma is not None and options.lambda_ is not None
        advantages = returns.gae(**steps, gamma=options.gamma, lambda_=options.lambda_).advantages
        is_absolute = self.score == "absolute"
        magnitudes = advantages.abs() if is_absolute else advantages.clamp(min=0.0)
        # of the episode so far: cumulative sums, minus those at the last episode's end
        rows = torch.stack([fixed(magnitudes, _LARGEST), (~rollout.reset).long()], 1)  # (T, 2, B)
        sums = rows.cumsum(0) + self.lanes
        ends = (rollout.terminal | rollout.truncated)[:, None]
        at_ends = torch.where(ends, sums, 0).cummax(0).values  # sums never fall
        before = torch.cat([torch.zeros_like(at_ends[:1]), at_ends[:-1]])
        totals, lengths = (sums - before).unbind(1)
        self.lanes.copy_(sums[-1] - at_ends[-1])
        means = totals // lengths.clamp(min=1)
        self._average(self.scores, n, self._sums(homes, means * ended))


def outcomes_of(rollout: Rollout) -> torch.Tensor | None:
    """Returns the outcome of the episodes that end, (T, B) from 0 to 1; None if no metric tells."""
    for names in OUTCOMES:
        if all(name in rollout.metrics for name in names):
            total = torch.as_tensor(sum(rollout.metrics[name] for name in names))
            return total.nan_to_num(0.0).clamp(0.0, 1.0)
    return None


def fixed(values: torch.Tensor, largest: float) -> torch.Tensor:
    """Returns non-negative numbers, at most `largest`, in fixed point: int64. NaN counts as 0."""
    return (values.nan_to_num(0.0, largest).clamp(0.0, largest) * _ONE).round().long()


def proportions(weights: torch.Tensor) -> torch.Tensor:
    """Returns weights (D,) divided by their sum; all equal if it is 0."""
    total = weights.sum()
    return torch.where(total > 0, weights / total, 1 / len(weights))
