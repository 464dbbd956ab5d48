"""Pong's scripted policy: it wins as often as the environment's own tracker."""

import pytest
import torch

from megastep import envs, spaces
from megastep.agents.evaluation import playing
from megastep.agents.evaluation.playing import first_episodes
from megastep.agents.selfplay.bots.random import RandomActions
from megastep.envs.pong import Tracker

ACTIONS = spaces.MultiDiscrete(1, 3)


def play(env, n_steps, bot):
    """Returns the actions (T, B) of a bot in all lanes of an environment."""
    world, state, actions = env.reset(), bot.initial(env.n_envs * env.n_agents, env.device), []
    for _ in range(n_steps):
        decision, state = bot(world, state)
        actions.append(decision.actions[:, 0])
        world = env.step(decision)
    return torch.stack(actions)


@pytest.mark.parametrize(
    "speed, pixels, n", [(0.25, False, 1000), (0.5, False, 1000), (0.5, True, 250)]
)
def test_plays_as_well_as_the_tracker_of_the_environment(speed, pixels, n):
    """Shares of points won against random actions, within three standard errors."""
    env, random = envs.Pong(1000, device="cpu", tracker_speed=speed), RandomActions(ACTIONS)
    theirs = 1 - first_episodes(env, random).metrics.points_won.mean()
    env = envs.Pong(n, device="cpu", self_play=True, pixels=pixels)
    ours = playing.first_duels(env, Tracker(speed), random).score.mean()
    assert 0.6 < theirs < 0.9 and abs(ours - theirs) < 3 * (0.25 / n + 0.25 / 1000) ** 0.5


def test_moves_whole_cells_at_its_mean_speed(device):
    env = envs.Pong(64, device=device, self_play=True, points=5)
    moved = (play(env, 200, Tracker(tracker_speed=0.25)) > 0).float()
    assert moved.unfold(0, 8, 1).sum(-1).max() == 2, "in 8 steps, at a quarter of a cell per step"


def test_other_observations_are_refused():
    env = envs.Minimal(2, device="cpu", res=8)
    with pytest.raises(ValueError, match="features or the pixels of Pong"):
        Tracker()(env.reset(), Tracker().initial(2))
