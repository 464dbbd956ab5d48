"""A benchmark of benchmark.py: the replay memory on the device."""

import torch
from timing import alone, measurement, rate

from megastep import spaces
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.replay import ReplayBuffer
from megastep.agents.storage.replay_settings import ReplaySettings
from megastep.agents.storage.rollout import Rollout

N_LANES = {"cuda": 16_384, "cpu": 256}
ROLLOUTS = {"cuda": 32, "cpu": 4}  # that are stored, on a GPU of 34 M observations
N_STEPS, WIDTH = 64, 256
SAMPLED = {"cuda": 4096, "cpu": 64}
OBS, ACTIONS = spaces.MultiImage(1, 3, 1, 64), spaces.MultiDiscrete(1, 7)


def filled(device, images):
    """A full memory of sequences of 64 steps, each with an LSTM's state of 256 units, and the
    rollout that it is filled from.
    """
    n_lanes = N_LANES[device.type]
    state = Policy(OBS, ACTIONS, width=WIDTH, critic=None).initial(n_lanes, device)
    rollout = Rollout(N_STEPS, n_lanes, OBS, ACTIONS, state, device, values=False)
    rollout.obs.uniform_()
    capacity = ROLLOUTS[device.type] * N_STEPS * n_lanes
    settings = ReplaySettings(capacity=capacity, images=images, alpha=0.9)
    before = torch.cuda.memory_allocated(device) if device.type == "cuda" else 0
    memory = ReplayBuffer(rollout, OBS, ACTIONS, settings)
    allocated = memory.bytes
    if device.type == "cuda":
        allocated = torch.cuda.memory_allocated(device) - before
    for _ in range(ROLLOUTS[device.type] + 1):
        memory.add(rollout)
    return memory, rollout, allocated


def replay(device):
    """The replay memory, of images of 64 pixels and three colours: observations per GB, all that
    is stored with them included, and how fast it is filled and drawn from, by priorities.
    """
    n_sampled = SAMPLED[device.type]
    for images in ("fp16", "uint8"):
        memory, rollout, allocated = filled(device, images)
        for unit, size in (("GB", 1e9), ("GiB", 2**30)):
            what = f"replay, {images}, 64 steps, LSTM of 256: observations per {unit}"
            yield measurement(what, "M", [memory.capacity / allocated * size / 1e6])
        n_added = rollout.n_steps * rollout.n_lanes
        times = alone(lambda i, add=memory.add, rollout=rollout: add(rollout), device)
        yield rate(f"replay, {images}, samples added", n_added, times)
        times = alone(lambda i, sample=memory.sample: sample(n_sampled), device)
        what = f"replay, {images}, {n_sampled:,} at a time, sequences of 64 drawn"
        yield rate(what, n_sampled, times)
    index = memory.sample(n_sampled).index
    values = torch.rand(n_sampled, device=device)
    times = alone(lambda i: memory.set_priorities(index, values), device)
    what = f"replay, {n_sampled:,} of {memory.tree.n:,} priorities at a time, set"
    yield rate(what, n_sampled, times)
