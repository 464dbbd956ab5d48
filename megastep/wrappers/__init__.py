"""Wrappers around any environment, on its device: `env.wrappers=[sticky_actions]`."""

from megastep.wrappers.actions import Latency, NoisyActions, StickyActions, TimeLimit
from megastep.wrappers.base import Wrapper
from megastep.wrappers.worlds import (
    ClipReward,
    DropSensor,
    FrameStack,
    NoisySensor,
    OdometryDrift,
    ScaleReward,
    ShapeReward,
)

#: Wrappers by their names in settings.
WRAPPERS = {
    "clip_reward": ClipReward,
    "drop_sensor": DropSensor,
    "frame_stack": FrameStack,
    "latency": Latency,
    "noisy_actions": NoisyActions,
    "noisy_sensor": NoisySensor,
    "odometry_drift": OdometryDrift,
    "scale_reward": ScaleReward,
    "shape_reward": ShapeReward,
    "sticky_actions": StickyActions,
    "time_limit": TimeLimit,
}

__all__ = ["WRAPPERS", "Wrapper", *(kind.__name__ for kind in WRAPPERS.values())]
