"""The benchmarks `exported` and `pages`: packaged agents in other runtimes and in web pages."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import torch
from timing import measurement, seconds_per_call

import megastep
from megastep.agents import pretrained
from megastep.agents.cli import web
from megastep.agents.cli.export import export
from megastep.agents.export import runtimes
from megastep.agents.export.step import Step

#: With an LSTM of 256 units.
AGENT = "explorer_anywhere"


def exported(device: torch.device) -> Iterator[dict]:
    """Time of one step of a packaged agent of 256 units as an ONNX file, in onnxruntime on one core
    of the CPU: one lane, with everything from the inputs' arrays to the outputs'.
    """
    run = megastep.load(AGENT)
    with tempfile.TemporaryDirectory() as folder:
        file = export(str(run.path), "onnx", str(Path(folder) / "agent.onnx"))
        act = runtimes.run_onnx(file)
        env = run.make(n_envs=1, device="cpu")
        step = Step(run.policy, env.obs_space)
        inputs = step.tensors(env.reset(), run.policy.initial(1))
        seconds = seconds_per_call(lambda: act(inputs), torch.device("cpu"))
    yield measurement(f"{AGENT}, one lane", "us/step", [1e6 * each for each in seconds])


def pages(device: torch.device) -> Iterator[dict]:
    """Sizes of the web pages of the packaged agents, one file each."""
    for name in pretrained.names():
        with tempfile.TemporaryDirectory() as folder:
            path = web.write(name, file=str(Path(folder) / "page.html"))
            yield measurement(f"{name}, page", "MB", [path.stat().st_size / 1e6])
