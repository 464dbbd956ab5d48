"""Measures trained policies: episodes in unseen homes, duels, ratings."""
