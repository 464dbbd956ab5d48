"""The benchmark `replay`: the replay buffer on the device."""

from collections.abc import Iterator

import torch
from timing import graph_seconds_per_call, measurement, rate

from megastep import spaces
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.replay import ReplayBuffer
from megastep.agents.storage.replay_settings import ReplaySettings
from megastep.agents.storage.rollout import Rollout

N_LANES = {"cuda": 16_384, "cpu": 256}
N_ROLLOUTS = {"cuda": 32, "cpu": 4}  # that are stored; on a GPU 34 M observations
N_STEPS, WIDTH = 64, 256
N_SAMPLED = {"cuda": 4096, "cpu": 64}
OBS_SPACE, ACTION_SPACE = spaces.MultiImage(1, 3, 1, 64), spaces.MultiDiscrete(1, 7)


def full_buffer(device: torch.device, images: str) -> tuple[ReplayBuffer, Rollout, int]:
    """Returns a full replay buffer, the rollout that fills it, and the buffer's size in bytes.

    Sequences have 64 steps, each with the hidden state of an LSTM of 256 units.
    """
    n_lanes = N_LANES[device.type]
    policy = Policy(OBS_SPACE, ACTION_SPACE, width=WIDTH, critic=None)
    hidden_state = policy.initial(n_lanes, device)
    rollout = Rollout(N_STEPS, n_lanes, OBS_SPACE, ACTION_SPACE, hidden_state, device, values=False)
    rollout.obs.uniform_()
    capacity = N_ROLLOUTS[device.type] * N_STEPS * n_lanes
    settings = ReplaySettings(capacity=capacity, images=images, alpha=0.9)
    before = torch.cuda.memory_allocated(device) if device.type == "cuda" else 0
    buffer = ReplayBuffer(rollout, OBS_SPACE, ACTION_SPACE, settings)
    n_bytes = buffer.bytes
    if device.type == "cuda":
        n_bytes = torch.cuda.memory_allocated(device) - before
    for _ in range(N_ROLLOUTS[device.type] + 1):
        buffer.add(rollout)
    return buffer, rollout, n_bytes


def replay(device: torch.device) -> Iterator[dict]:
    """The replay buffer with RGB images of 64 pixels: observations per GB, everything that is
    stored with them included, and how fast it is filled and sampled from by priority.
    """
    n_sampled = N_SAMPLED[device.type]
    for images in ("fp16", "uint8"):
        buffer, rollout, n_bytes = full_buffer(device, images)
        for unit, size in (("GB", 1e9), ("GiB", 2**30)):
            what = f"replay, {images}, 64 steps, LSTM of 256: observations per {unit}"
            yield measurement(what, "M", [buffer.capacity / n_bytes * size / 1e6])
        n_added = rollout.n_steps * rollout.n_lanes
        add, sample = buffer.add, buffer.sample
        seconds = graph_seconds_per_call(lambda i, add=add, rollout=rollout: add(rollout), device)
        yield rate(f"replay, {images}, samples added", n_added, seconds)
        seconds = graph_seconds_per_call(lambda i, sample=sample: sample(n_sampled), device)
        what = f"replay, {images}, {n_sampled:,} at a time, sequences of 64 drawn"
        yield rate(what, n_sampled, seconds)
    index = buffer.sample(n_sampled).index
    priorities = torch.rand(n_sampled, device=device)
    seconds = graph_seconds_per_call(lambda i: buffer.set_priorities(index, priorities), device)
    what = f"replay, {n_sampled:,} of {buffer.tree.n:,} priorities at a time, set"
    yield rate(what, n_sampled, seconds)
