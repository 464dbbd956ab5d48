"""Learners with an auxiliary head of their own, and schedules, as users write them."""

import torch

from megastep.agents.algorithms.masked_stats import masked_mean
from megastep.agents.algorithms.ppo import PPO
from megastep.agents.algorithms.r2d2 import R2D2
from megastep.agents.algorithms.vtrace import VTrace


class RewardHead:
    """Predicts the reward of each step from the features."""

    def extra_parameters(self):
        self.head = torch.nn.Linear(self.policy.width, 1)
        return self.head.parameters()

    def extra_loss(self, features, batch):
        loss, metrics = super().extra_loss(features, batch)
        error = self.head(features)[..., 0].float() - batch.reward
        error = masked_mean(error.square(), batch.valid)
        return loss + 0.1 * error, metrics | {"reward_error": error}


class Headed(RewardHead, PPO):
    pass


class HeadedVTrace(RewardHead, VTrace):
    pass


class HeadedR2D2(RewardHead, R2D2):
    pass


def falling(fraction):
    return 0.02 * (1 - fraction) ** 2


def rises(fraction):
    return 0.5 + fraction  # no discount
