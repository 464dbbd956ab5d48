"""The benchmark `peers`: trainers of other projects beside megastep's, in the same environment."""

import importlib.metadata
import importlib.util
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import torch
from timing import measurement

ADAPTERS = Path(__file__).resolve().parent / "peers"
#: Adapter, the module that it needs, its package, and precisions. The adapter's docstring states
#: the recipe, and how float32 is multiplied.
TRAINERS = (
    ("megastep", "megastep", None, ("bfloat16",)),
    ("pufferlib", "pufferlib", "pufferlib==3.0.0", ("float32", "bfloat16")),
    ("rsl_rl", "rsl_rl", "rsl-rl-lib", ("float32", "bfloat16")),
)
N_LANES = {"cuda": 4096, "cpu": 16}
LAP_SECONDS = {"cuda": 6.0, "cpu": 0.5}
#: Settings of the environment; tests use a smaller one.
WORDS = ()


def peers(device: torch.device) -> Iterator[dict]:
    """Trained samples per second of Explorer with an LSTM of 256 units, 32 steps, 4 minibatches and
    one epoch: by megastep's trainer, PufferLib's and rsl_rl's, one after the other, each in a
    process of its own.

    The time is that of the host's clock between two synchronisations. Reports and checkpoints are
    on. An adapter in scripts/benchmarks/peers/ states each recipe.
    """
    for _, module, package, _ in TRAINERS:
        if importlib.util.find_spec(module) is None:
            raise ValueError(f"{module} is not installed: pip install {package}")
    for name, _, package, precisions in TRAINERS:
        version = package and importlib.metadata.version(package.partition("=")[0])
        for precision in precisions:
            what = f"Explorer, LSTM-256, {' '.join(filter(None, (name, version)))}, {precision}"
            try:
                rates = _measured(name, precision, device)
            except subprocess.CalledProcessError as error:
                print(f"{what} failed with exit code {error.returncode}", file=sys.stderr)
                continue
            yield measurement(what, "M/s", [rate / 1e6 for rate in rates])


def _measured(name, precision, device):
    """Returns the samples per second of each lap of a trainer."""
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / "rates.json"
        lanes, seconds = N_LANES[device.type], LAP_SECONDS[device.type]
        command = [sys.executable, ADAPTERS / f"with_{name}.py", "--device", str(device)]
        command += ["--lanes", str(lanes), "--lap-seconds", str(seconds)]
        command += ["--precision", precision, "--result", result, *WORDS]
        # stdout is for the table of measurements, and a trainer's own is of no use
        subprocess.run(command, cwd=folder, stdout=subprocess.DEVNULL, check=True)
        return json.loads(result.read_text())
