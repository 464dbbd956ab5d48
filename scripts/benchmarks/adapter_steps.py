"""Benchmark of environments in other libraries: `adapters`."""

import statistics
from collections.abc import Iterator

import torch
from random_walks import N_HOMES
from timing import measurement, rate, seconds_per_call

from megastep import adapters as adapting
from megastep import contract, envs
from megastep.arrdict import arrdict
from megastep.capture import Captured
from megastep.geometries import sample

N_ENVS = {"cuda": (1024, 4096, 16_384, 65_536), "cpu": (256, 1024)}
N_DECISIONS = 32  # taken in turn


def adapters(device: torch.device) -> Iterator[dict]:
    """Frames per second of Explorer, with metrics, by `env.step` as a CUDA graph, and by the steps
    of `megastep.adapters.VectorEnv` with the same actions: tensors in the three modes of autoreset,
    copied or not, and arrays, also as a share of the former. "With resets", a masked reset follows
    each step.
    """
    for n_envs in N_ENVS[device.type]:
        homes = sample("bench", N_HOMES)

        def make(homes=homes, n_envs=n_envs):
            return envs.Explorer(n_envs, homes, resample=True, device=device)

        env = make()
        generator = torch.Generator().manual_seed(1)
        actions = [contract.random_actions(env, generator) for _ in range(N_DECISIONS)]
        native = Captured(env)
        native.reset()

        def step(i, native=native, actions=actions):
            native.step(arrdict(actions=actions[i % N_DECISIONS]))

        what = f"explorer, {n_envs:,} environments"
        unkept = dict(to_numpy=False, copy=False)
        whole = seconds_per_call(numbered(step), device)
        yield rate(f"{what}, native", n_envs, whole)
        for name, settings in (
            ("NEXT_STEP, tensors", dict(autoreset_mode="next_step", to_numpy=False)),
            ("NEXT_STEP, tensors, copy=False", unkept),
            ("DISABLED, tensors", dict(autoreset_mode="disabled", to_numpy=False)),
            ("DISABLED, tensors, copy=False", dict(autoreset_mode="disabled") | unkept),
            ("DISABLED, tensors, with resets", dict(autoreset_mode="disabled", to_numpy=False)),
            ("SAME_STEP, tensors", dict(autoreset_mode="same_step", to_numpy=False)),
            ("NEXT_STEP, arrays", dict()),
        ):
            vector = adapting.VectorEnv(make(), **settings)
            vector.reset()
            given = [action[:, 0] for action in actions]
            if vector.to_numpy:
                given = [action.cpu().numpy() for action in given]

            def take_step(i, vector=vector, given=given, resets="with resets" in name):
                _, _, terminated, truncated, _ = vector.step(given[i % N_DECISIONS])
                if resets:
                    vector.reset(options={"reset_mask": terminated | truncated})

            seconds = seconds_per_call(numbered(take_step), device)
            yield rate(f"{what}, {name}", n_envs, seconds)
            shares = [100 * statistics.median(whole) / one for one in seconds]
            yield measurement(f"{what}, {name}: of native", "%", shares)


def numbered(function):
    """Returns a function without arguments that counts its calls."""
    calls = iter(range(2**62))
    return lambda: function(next(calls))
