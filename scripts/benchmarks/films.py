"""The benchmark `films`: how fast `record.py` draws and encodes."""

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import torch
from timing import measurement

from megastep import envs, recording
from megastep.agents.selfplay.bots.random import RandomActions
from megastep.geometries import sample

N_FRAMES, N_FILMS = 200, 5


def films(device: torch.device) -> Iterator[dict]:
    """Frames per second of films of Explorer at 720 lines, with stepping, drawing and encoding: of
    one home, 640 x 720 pixels, and of two side by side, 1280 x 720.
    """
    for homes in sample("bench", 1), sample("bench", 2):
        rates = []
        for _ in range(N_FILMS + 1):  # the first imports what it needs
            made = [envs.Explorer(1, [home], device=device) for home in homes]
            players = [recording.Player(env, RandomActions(env.action_space)) for env in made]
            with tempfile.TemporaryDirectory() as folder:
                start = time.perf_counter()
                recording.film_all(players, Path(folder) / "film.mp4", N_FRAMES)
                rates.append(N_FRAMES / (time.perf_counter() - start))
        yield measurement(f"film, {640 * len(homes)} x 720 pixels", "frames/s", rates[1:])
