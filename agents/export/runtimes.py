"""Files of other runtimes: ONNX, and the format of `torch.export`; and whether they act alike."""

import contextlib
import importlib
import json
import logging
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, cast

import torch

from megastep.agents import package
from megastep.agents.errors import UserError, shortened
from megastep.agents.export.step import Step
from megastep.agents.networks.fused import plain_operations
from megastep.agents.networks.outputs import FORBIDDEN
from megastep.arrdict import arrdict
from megastep.atomic_files import write_atomically
from megastep.dotdict import leaves
from megastep.types import Env, n_lanes

if TYPE_CHECKING:
    from megastep.agents.networks.policy import Policy

#: Version of ONNX's operators.
OPSET = 18
#: Largest difference of logits, as a fraction of the largest logit (or of 1), that is no error.
MAX_DIFFERENCE = 1e-3
#: Fraction of steps at which a comparison also resets.
RESETS = 0.02

#: Outputs, as NumPy arrays or tensors, from inputs.
Runner = Callable[[Sequence[torch.Tensor]], Sequence[torch.Tensor]]


class Comparison(NamedTuple):
    """How far a file and its policy are apart.

    Attributes:
        difference: largest absolute difference of logits, continuous actions and hidden states; of
            logits that a mask forbids only if the other does not. NaN if a number is.
        n_apart: greedy actions that differ though their logits differ by more than that.
        largest: absolute value of the logits and states.
    """

    difference: float
    n_apart: int
    largest: float


def program(step: Step, name: str = "") -> "torch.export.ExportedProgram":
    """Returns a step as a graph of PyTorch's operators, of any number of lanes.

    Raises:
        UserError: a core or an encoder of the user's cannot be exported.
    """
    lanes = torch.export.Dim("lanes")
    dynamic = (tuple({0: lanes} for _ in step.example),)
    try:
        with plain_operations(), _quiet():
            return torch.export.export(step, step.example, dynamic_shapes=dynamic, strict=False)
    except Exception as error:  # whatever a module of the user's does
        raise UserError(
            f"{name or 'the policy'} cannot be exported: torch.export does not take its core or "
            f"encoder ({shortened(error)}); format=safetensors needs no graph"
        ) from error


def write_torch(step: Step, path: Path, name: str = "") -> None:
    """Writes a file for `torch.export.load`, with its ports as the extra file `ports.json`."""
    made = program(step, name)
    temporary = path.with_name(f".{path.stem}.pt2")
    try:
        with _quiet():
            torch.export.save(made, temporary, extra_files={"ports.json": _ports(step)})
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_onnx(step: Step, path: Path, name: str = "") -> None:
    """Writes an ONNX file, with its ports as the metadata `megastep`.

    Raises:
        UserError: the packages are missing; or as `program`.
    """
    require("onnx", "onnxscript")
    made, names = program(step, name), [[port.name for port in p] for p in _sides(step)]
    with _quiet():
        model = torch.onnx.export(
            made,
            (),
            input_names=names[0],
            output_names=names[1],
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
        )
    assert model is not None
    model.model.metadata_props["megastep"] = _ports(step)
    write_atomically(path, model.model_proto.SerializeToString())


def run_torch(path: Path) -> Runner:
    """Returns what runs a file of `write_torch`."""
    with _quiet():
        module = torch.export.load(path).module()
    return lambda inputs: module(*inputs)


def run_onnx(path: Path) -> Runner:
    """Returns what runs a file of `write_onnx` on one core."""
    (runtime,) = require("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = runtime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    names = [port.name for port in session.get_inputs()]

    def run(inputs) -> list[torch.Tensor]:
        feeds = {name: one.numpy() for name, one in zip(names, inputs, strict=True)}
        return [*map(torch.as_tensor, session.run(None, feeds))]

    return run


@torch.no_grad()
def compare(step: Step, run: Runner, policy: "Policy", env: Env, n_steps: int = 1000) -> Comparison:
    """Returns how far apart a file and a policy are: both act on the same worlds, each with its own
    hidden state, with more resets than the environment's own.
    """
    world, state = env.reset(), policy.initial(n_lanes(env))
    own = state.map(torch.clone) if state else state
    generator = torch.Generator().manual_seed(1)
    difference, largest, choices = torch.zeros(()), 0.0, []
    for _ in range(n_steps):
        is_random = torch.rand(len(world["reset"]), generator=generator) < RESETS
        world = arrdict(cast(arrdict, world), reset=world["reset"] | is_random)
        decision, state = policy(world, state, sample=False)
        actions, logits, own = step.trees(run(step.tensors(world, own)))
        expected = [*leaves(decision["logits"]), *leaves(state)]
        for mine, theirs in zip([*logits, *leaves(own)], expected, strict=True):
            is_allowed = (mine > FORBIDDEN / 2) | (theirs > FORBIDDEN / 2) | mine.isnan()
            mine, theirs = (leaf.where(is_allowed, 0.0) for leaf in (mine, theirs))
            difference = difference.maximum((mine - theirs).abs().max())
            largest = max(largest, theirs.abs().max().item())
        for mine, theirs, scores in zip(actions, leaves(decision["actions"]), logits, strict=True):
            if theirs.is_floating_point():
                difference = difference.maximum((mine - theirs).abs().max())
            else:
                best = scores.topk(2, -1).values if scores.shape[-1] > 1 else scores.new_ones(1, 2)
                choices.append((mine != theirs, best[..., 0] - best[..., 1]))
        world = env.step(decision)
    n_apart = sum(int((is_other & (gap > 2 * difference)).sum()) for is_other, gap in choices)
    return Comparison(difference.item(), n_apart, largest)


def check(path: Path, comparison: Comparison) -> None:
    """Raises UserError if a file acts otherwise than its policy."""
    is_alike = comparison.difference <= MAX_DIFFERENCE * max(1, comparison.largest)  # also if NaN
    if comparison.n_apart or not is_alike:
        raise UserError(
            f"{path} acts otherwise than its policy: logits differ by {comparison.difference:.2g}, "
            f"and {comparison.n_apart} actions"
        )


def require(*names: str) -> list:
    """Returns modules of the extra `export`. Raises UserError if one is missing."""
    try:
        return [importlib.import_module(name) for name in names]
    except ImportError as error:
        cure = f"pip install '{package.DISTRIBUTION}[export]'"
        raise UserError(f"format=onnx needs {error.name}: {cure}") from None


def _sides(step) -> tuple:
    return step.inputs, step.outputs


def _ports(step) -> str:
    inputs, outputs = ([port._asdict() for port in side] for side in _sides(step))
    return json.dumps({"inputs": inputs, "outputs": outputs})


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Leaves out what exporters say of packages that are not needed."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
