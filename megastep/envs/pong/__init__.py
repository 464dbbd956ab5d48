"""Pong: the environment, and its step as one operation (with its kernel)."""

from megastep.envs.pong.env import Pong

__all__ = ["Pong"]
