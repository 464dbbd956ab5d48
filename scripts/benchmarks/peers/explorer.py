"""What all adapters share: Explorer on tensors, and the clock.

An adapter is a program of its own, since trainers change settings of the whole process. It takes
the arguments of `arguments`, trains until the clock has enough, and writes a file of JSON: samples
per second of each lap.
"""

import argparse
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))  # this checkout comes first

import torch

from megastep import arrdict, capture
from megastep.agents import factory
from megastep.agents.cli.compose import Composer
from megastep.agents.cli.scripts import SCRIPTS
from megastep.agents.factory.settings import Train

N_STEPS, N_MINIBATCHES, WIDTH = 32, 4, 256
#: Iterations before the first lap: they compile, choose kernels and capture graphs.
N_WARM_UPS = 10
N_LAPS = 5


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=sys.modules["__main__"].__doc__)
    parser.add_argument("--device", required=True)
    parser.add_argument("--lanes", type=int, required=True)
    parser.add_argument("--lap-seconds", type=float, required=True)
    parser.add_argument("--precision", choices=("float32", "bfloat16"), default="float32")
    parser.add_argument("--result", type=Path, required=True, help="the file to write")
    parser.add_argument("words", nargs="*", help="settings of the environment, as of train.py")
    return parser.parse_args()


def settings(given: argparse.Namespace, *words: str) -> Train:
    """Returns the settings of `python train.py` with bench homes and the benchmark's sizes."""
    sizes = (
        f"env.n_envs={given.lanes}",
        f"agent.width={WIDTH}",
        f"learner.n_steps={N_STEPS}",
        f"learner.n_minibatches={N_MINIBATCHES}",
        f"device={given.device}",
    )
    return Composer(SCRIPTS["train"]).settings(["geometry=bench", *sizes, *words, *given.words])


class Clock:
    """Counts the samples of laps between two synchronised times, after warming up.

        while not clock.is_done(n_samples):
            ...  # one iteration

    Args:
        given: the adapter's arguments.
    """

    def __init__(self, given: argparse.Namespace):
        self.given, self.n_calls, self.rates = given, 0, []

    def is_done(self, n_samples: int) -> bool:
        """Returns whether all laps are timed, and writes them then. Call it before each iteration.

        Args:
            n_samples: samples trained on so far.
        """
        self.n_calls += 1
        if self.n_calls == N_WARM_UPS + 1:
            self._start(n_samples)
        elif self.n_calls > N_WARM_UPS and self._seconds() >= self.given.lap_seconds:
            self._synchronise()
            self.rates.append((n_samples - self.n_before) / self._seconds())
            self._start(n_samples)
            if len(self.rates) == N_LAPS:
                self.given.result.write_text(json.dumps(self.rates))
        return len(self.rates) == N_LAPS

    def _start(self, n_samples):
        self._synchronise()
        self.n_before, self.started = n_samples, time.perf_counter()

    def _seconds(self):
        return time.perf_counter() - self.started

    def _synchronise(self):
        if self.given.device != "cpu":
            torch.cuda.synchronize()


class Explorer:
    """Explorer with flat float32 observations. On a GPU a step is one CUDA graph, as in megastep's
    own trainer.

    A lane whose episode has ended starts the next one in the following step, which is `done` and
    returns the first observation.

    Args:
        given: the adapter's arguments.
        privileged: computes what only a critic may see.

    Attributes:
        obs: (B, D), the current observations.
        privileged: (B, P), or None.
    """

    def __init__(self, given: argparse.Namespace, privileged: bool):
        cfg = settings(given)
        device = factory.make_device(cfg.device)
        homes = factory.homes(cfg.env, cfg.geometry, "training")
        where = dict(geometries=homes, seed=cfg.seed, device=device, privileged=privileged)
        env = factory.construct(cfg.env, **where)
        self.device, self.n_lanes = device, cfg.env.n_envs
        self.n_actions = env.action_space.n_actions
        self.obs, self.privileged = _views(env.reset())

        def step(actions):
            world = env.step(arrdict.arrdict(actions=actions))
            return *_views(world), world["reward"], world["reset"]

        actions = torch.zeros(self.n_lanes, 1, dtype=torch.int64, device=device)
        self._step = step
        if device.type == "cuda":
            self._step = capture.capture(step, (actions,), (env,))

    def step(self, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Steps by actions (B,) of any integer dtype. Returns reward and `done`, (B,) each."""
        self.obs, self.privileged, reward, done = self._step(actions.long()[:, None])
        return reward, done


def _views(world):
    """Returns observations and what is privileged, None without it, as (B, D) float32."""
    return [
        torch.cat([leaf.flatten(1).float() for leaf in world[key].values()], 1)
        if key in world
        else None
        for key in ("obs", "privileged")
    ]
