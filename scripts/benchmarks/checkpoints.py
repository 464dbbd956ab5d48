"""The benchmark `checkpoints`: what saving a run costs its training."""

import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import torch
from timing import measurement

from megastep.agents.cli.compose import Composer
from megastep.agents.cli.train import COMMAND
from megastep.agents.factory.trainer import make_trainer

#: Environments, and the settings with which so many fit beside what trains.
SIZES = {
    "cuda": {4096: (), 1_048_576: ("learner.n_steps=4", "learner.n_minibatches=16")},
    "cpu": {256: (), 4096: ()},
}
N_SAVES = 5
INTERVAL = 30.0  # seconds, the default of checkpoint_seconds


def checkpoints(device: torch.device) -> Iterator[dict]:
    """Explorer as it is trained, with the default settings: the bytes of a checkpoint, the seconds
    for which training waits for its copy, the seconds until a thread has written and verified it,
    and the share of the training that checkpoints every 30 s cost, writing included.
    """
    for n_envs, words in SIZES[device.type].items():
        folder = Path(tempfile.mkdtemp())
        try:
            yield from _costs(device, n_envs, words, folder)
        finally:
            shutil.rmtree(folder)


def _costs(device, n_envs, words, folder):
    words = ["env=explorer", f"env.n_envs={n_envs}", f"device={device}", *words]
    cfg = Composer(COMMAND).settings([*words, "samples=1e12", "env.resample=true"])
    running = make_trainer(cfg, folder, device)
    waits, writes, costs = [], [], []
    for _ in range(3):
        running.update()  # the first ones compile and capture
    for _ in range(N_SAVES + 1):
        began = time.perf_counter()
        running.update()
        _synchronise(device)
        saves = time.perf_counter()
        running.save()
        waits.append(time.perf_counter() - saves)
        n_updates = 1
        while running.saver.is_writing or n_updates < 3:
            running.update()
            _synchronise(device)
            n_updates += 1
        with_checkpoint = time.perf_counter() - began
        running.saver.wait()
        if running.saver.error:
            raise OSError(running.saver.error)
        writes.append(running.saver.seconds)
        began = time.perf_counter()
        for _ in range(n_updates):
            running.update()
            _synchronise(device)
        costs.append(with_checkpoint - (time.perf_counter() - began))
    n_bytes = sum(path.stat().st_size for path in (folder / "checkpoints").glob("*/*"))
    n_bytes /= len([*(folder / "checkpoints").iterdir()])
    title = f"checkpoints, Explorer, {n_envs:,} environments"
    yield measurement(f"{title}: size", "MB", [n_bytes / 1e6])
    yield measurement(
        f"{title}: training waits for the first, which pins memory", "ms", [1e3 * waits[0]]
    )
    yield measurement(f"{title}: training waits for the copy", "ms", [1e3 * s for s in waits[1:]])
    yield measurement(f"{title}: written and verified after", "ms", [1e3 * s for s in writes[1:]])
    share = [100 * seconds / INTERVAL for seconds in costs[1:]]
    yield measurement(f"{title}: share of training, one every 30 s", "%", share)


def _synchronise(device):
    if device.type == "cuda":
        torch.cuda.synchronize(device)
