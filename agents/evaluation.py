"""What a policy earns: the first episode of every lane, and how sure that is.

B lanes, N worlds, A agents. Nothing here asks the device a question more often than every `CHECK`
steps.
"""

import numpy as np
import torch

from megastep.arrdict import arrdict
from megastep.dotdict import mapping

#: Steps between two looks at whether all lanes are done: a look empties a GPU's queue, a
#: superfluous step costs little.
CHECK = 64


class RandomActions:
    """A policy that draws every action evenly; the row a trained one is compared with."""

    def __init__(self, action_space):
        self.action_space = action_space

    def initial(self, n_lanes, device):
        return arrdict(lane=torch.zeros(n_lanes, device=device))

    def __call__(self, world, state, sample=True, generator=None):
        lanes = len(state.lane)

        @mapping
        def draw(space):
            return torch.randint(
                space.n_actions,
                (lanes, *space.shape),
                device=state.lane.device,
                generator=generator,
            )

        return arrdict(actions=draw(self.action_space)), state


@torch.no_grad()
def first_episodes(env, policy, seed=1, greedy=False, max_steps=100_000):
    """Plays each lane's first episode: arrdict of returns (B,), lengths (B,), done (B,), on the
    environment's device.

    An episode still going after `max_steps` is reported as it stands, with done False.
    """
    device, lanes = torch.device(env.device), env.n_envs * env.n_agents
    generator = torch.Generator(device).manual_seed(seed)
    world, state = env.reset(), policy.initial(lanes, device)
    returns, lengths = (torch.zeros(lanes, device=device) for _ in range(2))
    done = torch.zeros(lanes, dtype=torch.bool, device=device)
    for step in range(max_steps):
        if step % CHECK == 0 and bool(done.all()):
            break
        decision, state = policy(world, state, sample=not greedy, generator=generator)
        world = env.step(decision)
        returns += torch.where(done, 0.0, world.reward)
        lengths += ~done
        done |= world.terminal | world.truncated
    return arrdict(returns=returns, lengths=lengths, done=done)


def interval(values, groups, level=0.95, n_resamples=2000, seed=1):
    """The mean of `values` (B,) and a bootstrap interval for it that resamples whole groups:
    `(mean, low, high)`.

    Lanes in one home are alike, so it is homes (`groups`, (B,) whole numbers) that are drawn, with
    replacement: Efron and Tibshirani, An Introduction to the Bootstrap, 1993, section 13.3. With
    one home, lanes are drawn.
    """
    values, groups = np.asarray(values, float), np.asarray(groups)
    if len(np.unique(groups)) == 1:
        groups = np.arange(len(values))
    _, groups = np.unique(groups, return_inverse=True)
    sums, counts = np.bincount(groups, values), np.bincount(groups)
    chosen = np.random.default_rng(seed).integers(len(sums), size=(n_resamples, len(sums)))
    means = sums[chosen].sum(1) / counts[chosen].sum(1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return float(values.mean()), float(low), float(high)


def summary(episodes, groups):
    """A table's row: the mean return with its 95 % interval, the mean length, and what they were
    taken over.
    """
    mean, low, high = interval(episodes.returns.cpu().numpy(), groups)
    return {
        "return": mean,
        "low": low,
        "high": high,
        "length": float(episodes.lengths.mean()),
        "lanes": len(episodes.returns),
        "homes": len(np.unique(groups)),
        "unfinished": int((~episodes.done).sum()),
    }
