"""Policies that play or walk without learning."""

from megastep.agents.selfplay.bots.random_actions import RandomActions as RandomActions
