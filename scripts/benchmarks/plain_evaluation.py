"""A second evaluator: one environment of Gymnasium at a time, stepped as its pages show.

It shares with `evaluate.py` only the reading of a checkpoint: no vector environment, no resets in
the next step, no conversion of spaces. For observations and actions that are one Box or Discrete.
"""

from pathlib import Path

import numpy as np
import torch

from megastep import arrdict
from megastep.agents import factory
from megastep.agents.factory import settings
from megastep.agents.runs import folders
from megastep.imports import import_object


def returns(run: Path, n_episodes: int, seed: int) -> list[float]:
    """Returns the return of each of `n_episodes` episodes of a run's last policy, which takes its
    most likely actions.
    """
    import gymnasium

    loaded = folders.load_checkpoint(folders.find(str(run)), False, torch.device("cpu"))
    trained = factory.config_of(loaded)
    sample = factory.construct(settings.changed(trained.env, n_envs=1), device="cpu", seed=seed)
    policy = factory.make_policy(trained.agent, sample)
    policy = factory.load_weights(policy, sample, loaded)
    package, _, name = trained.env.id.rpartition(":")
    env = gymnasium.make(f"{package}:{name}" if package else name, **(trained.env.kwargs or {}))
    for wrapper in trained.env.wrappers or ():
        env = import_object(wrapper)(env)
    actions, results = env.action_space, []
    for episode in range(n_episodes):
        obs, _ = env.reset(seed=seed + episode)
        state, is_first, total, done = policy.initial(1), True, 0.0, False
        while not done:
            tensor = torch.as_tensor(obs, dtype=torch.float32).reshape(1, 1, -1)
            world = arrdict.arrdict(obs=tensor, reset=torch.tensor([is_first]))
            with torch.no_grad():
                decision, state = policy(world, state, sample=False)
            chosen = decision.actions.numpy().reshape(actions.shape).astype(actions.dtype)
            chosen = np.clip(chosen, actions.low, actions.high) if actions.shape else chosen.item()
            obs, reward, terminated, truncated, _ = env.step(chosen)
            total, is_first, done = total + reward, False, terminated or truncated
        results.append(total)
    return results
