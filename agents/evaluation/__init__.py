"""Measures trained policies: episodes in unseen homes, duels, ratings."""

from megastep.agents.evaluation.episodes import Evaluation, evaluate

__all__ = ["Evaluation", "evaluate"]
