"""One step of a policy as a function of tensors alone, in files of other runtimes: ONNX, and the
format of `torch.export`; and whether they act alike.

B lanes. Inputs in this order: `obs` or `obs.NAME` for each leaf of the observation; `mask` or
`mask.NAME`, if the environment has action masks; `reset`; and `state.0`, `state.1`, ... for the
leaves of the hidden state. Outputs: `action`, `logits` (or `action.NAME`, `logits.NAME`) and
`next_state.0`, ...
"""

import contextlib
import importlib
import io
import json
import logging
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, cast

import torch
from torch import nn

from megastep import spaces
from megastep.agents import package
from megastep.agents.errors import UserError, shortened, user_errors
from megastep.agents.factory import components, settings
from megastep.agents.factory import make as factory
from megastep.agents.networks.fused import plain_operations
from megastep.agents.networks.heads import FORBIDDEN
from megastep.agents.networks.policy import Policy
from megastep.agents.runs import folders, restore
from megastep.arrdict import arrdict
from megastep.atomic_files import write_atomically
from megastep.dotdict import leaves, mapping
from megastep.types import Env, Tree, World, n_lanes, optional

FLOAT = torch.float32  # of the floating-point inputs
#: Version of ONNX's operators.
OPSET = 18
#: Largest difference of logits, as a fraction of the largest logit (or of 1) that a file may have.
MAX_DIFFERENCE = 1e-3
#: Homes of the environment in which it is made: floor plans change no spaces.
N_HOMES = 4
#: Fraction of steps at which a comparison also resets.
RESETS = 0.02

#: Outputs, as NumPy arrays or tensors, from inputs.
Runner = Callable[[Sequence[torch.Tensor]], Sequence[torch.Tensor]]


class Port(NamedTuple):
    """An input or output."""

    name: str  # as at the head of this file
    shape: tuple[int, ...]  # without the axis B
    dtype: str  # of PyTorch, without `torch.`


class Step(nn.Module):
    """Acts greedily for one step, as `policy(world, state, sample=False)` does on a CPU; `world` is
    an example of what it sees.
    """

    def __init__(self, policy: Policy, world: World):
        super().__init__()
        self.policy = policy.actor().eval()
        self.masks = [*spaces.leaves(world["mask"])] if "mask" in world else []
        # a graph of any number of lanes needs an example of more than one
        world = arrdict({name: world[name] for name in ("obs", "mask", "reset") if name in world})
        world = world.map(lambda leaf: torch.stack(2 * [leaf[0]]))
        state = self.policy.initial(2)
        self.n_state = len(leaves(state))
        self.example = self.tensors(world, state)
        seen = {"obs": self.policy.intake.paths, "mask": self.masks, "reset": [""]}
        self.inputs = _ports(self.example, {**seen, "state": range(self.n_state)})
        paths = [*spaces.leaves(self._acted(self.example)[1])]
        names = {"action": paths, "logits": paths, "next_state": range(self.n_state)}
        self.outputs = _ports(self(*self.example), names)

    @property
    def ports(self) -> str:
        sides = {"inputs": self.inputs, "outputs": self.outputs}
        return json.dumps({name: [port._asdict() for port in side] for name, side in sides.items()})

    @torch.no_grad()
    def forward(self, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return tuple(leaf for tree in self._acted(tensors) for leaf in leaves(tree))

    def tensors(self, world: World, state: arrdict) -> tuple[torch.Tensor, ...]:
        """Returns the inputs for a world and a hidden state."""
        obs = spaces.leaves(world["obs"])
        values = [obs[path] for path in self.policy.intake.paths]
        values = [leaf.to(FLOAT) if leaf.is_floating_point() else leaf for leaf in values]
        masks = spaces.leaves(world["mask"]) if self.masks else {}
        return *values, *(masks[path] for path in self.masks), world["reset"], *leaves(state)

    def trees(self, outputs: Sequence[torch.Tensor]) -> tuple[list, list, arrdict]:
        """Returns leaves of actions, leaves of logits and the hidden state of outputs."""
        n = (len(outputs) - self.n_state) // 2
        state = _filled(self.policy.initial(1), [*outputs[2 * n :]])
        return [*outputs[:n]], [*outputs[n : 2 * n]], state

    def _acted(self, tensors) -> tuple[Tree, Tree, arrdict]:
        """Returns actions, logits and the next hidden state."""
        paths, output = self.policy.intake.paths, self.policy.output
        n, end = len(paths), len(paths) + len(self.masks)
        mask = spaces.nested(dict(zip(self.masks, tensors[n:end]))) if self.masks else None
        state, reset = _filled(self.policy.initial(1), [*tensors[end + 1 :]]), tensors[end]
        obs = mapping(torch.unsqueeze)(spaces.nested(dict(zip(paths, tensors[:n]))), 0)
        features, state = self.policy._features(obs, reset[None], state)
        logits = output(features[0])
        logits = logits if mask is None else output.masked(logits, mask)
        return output.greedy(logits), logits, state


def _ports(tensors, paths_by_kind) -> list[Port]:
    names = [
        f"{kind}.{path}".rstrip(".") for kind, paths in paths_by_kind.items() for path in paths
    ]
    return [
        Port(name, tuple(tensor.shape[1:]), str(tensor.dtype).removeprefix("torch."))
        for name, tensor in zip(names, tensors, strict=True)
    ]


def _filled(tree, values) -> arrdict:
    return tree.map(lambda leaf: values.pop(0)) if tree else tree


# ---- Files ----


def write(run: Path, path: Path) -> str:
    """Writes a step of a run's policy, as `save` does, and compares what runs it with the policy.
    Returns what was written. UserError if the file cannot be written, or acts otherwise.
    """
    loaded = folders.load_checkpoint(run, False, "cpu")
    trained = factory.config_of(loaded)
    try:
        env = _env(trained, components.settings_for("geometry", components.HOMES, n=N_HOMES))
    except UserError:  # its environment needs floor plans of another kind
        env = _env(trained, settings.changed_known(trained.geometry, n=N_HOMES))
    restore.load_wrappers(env, loaded)
    policy = restore.policy_of(loaded, env)
    step = Step(policy, env.reset())
    with user_errors(f"{path} cannot be written: ", (OSError,)):
        path.parent.mkdir(parents=True, exist_ok=True)
        save(step, path, folders.name_of(run))
        if path.suffix == ".onnx":
            text = json.dumps(description(step, env), indent=1)
            write_atomically(path.with_suffix(".json"), text.encode())
    difference = compare(step, runner(path), policy, env, path)
    inputs, outputs = (
        ", ".join(port.name for port in side) for side in (step.inputs, step.outputs)
    )
    return (
        f"{inputs} -> {outputs}; in 1,000 steps its numbers differ from the policy's by at most "
        f"{difference:.1g}"
    )


def _env(trained, geometry) -> Env:
    homes = factory.homes(trained.env, geometry, "test")
    return factory.make_sample(trained.env, homes, seed=trained.seed, device="cpu")


def description(step: Step, env: Env) -> dict:
    """Returns what a program beside a policy's file must know: steps per second, names and shapes,
    bounds and distributions of continuous actions, and what the environment's ``describe()`` says,
    if it has one.
    """
    sides = json.loads(step.ports)
    for port in sides["outputs"]:
        path = port["name"].partition(".")[2]
        space = spaces.leaves(env.action_space).get(path)
        if isinstance(space, spaces.MultiContinuous):
            if port["name"].startswith("action"):
                port.update(low=space.low, high=space.high)
            elif port["name"].startswith("logits"):
                port.update(distribution=step.policy.settings["continuous"])
    about = getattr(env, "describe", dict)()
    return {"steps_per_second": optional(env, "fps"), **sides, **about}


def save(step: Step, path: Path, name: str = "the policy") -> None:
    """Writes a step as a graph of PyTorch's operators, of any number of lanes: an ONNX file, with
    its ports as the metadata `megastep`, or one for `torch.export.load`, with its ports as
    `ports.json`. UserError if packages are missing, or a part of the user's cannot be exported.
    """
    is_onnx, content = path.suffix == ".onnx", io.BytesIO()
    if is_onnx:
        require("onnx", "onnxscript")
    lanes = torch.export.Dim("lanes")
    dynamic = (tuple({0: lanes} for _ in step.example),)
    try:
        with plain_operations(), _quiet():
            made = torch.export.export(step, step.example, dynamic_shapes=dynamic, strict=False)
    except Exception as error:  # whatever a module of the user's does
        raise UserError(
            f"{name} cannot be exported: torch.export does not take its core or encoder "
            f"({shortened(error)}); format=safetensors needs no graph"
        ) from error
    with _quiet():
        if is_onnx:
            names = [[port.name for port in side] for side in (step.inputs, step.outputs)]
            names = dict(zip(("input_names", "output_names"), names))
            model = torch.onnx.export(
                made, (), **names, opset_version=OPSET, dynamo=True, verbose=False
            )
            assert model is not None
            model.model.metadata_props["megastep"] = step.ports
            content.write(model.model_proto.SerializeToString())
        else:
            torch.export.save(made, content, extra_files={"ports.json": step.ports})
    write_atomically(path, content.getvalue())


def runner(path: Path) -> Runner:
    """Returns what runs a file of `save`, an ONNX file on one core."""
    if path.suffix != ".onnx":
        with _quiet():
            module = torch.export.load(path).module()
        return lambda inputs: module(*inputs)
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
def compare(
    step: Step, run: Runner, policy: Policy, env: Env, name: object, n_steps: int = 1000
) -> float:
    """Returns how far apart the numbers of a file and of a policy are in the same worlds, with more
    resets than the environment's own. UserError if the file acts otherwise.
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
    if n_apart or not difference <= MAX_DIFFERENCE * max(1, largest):  # also if NaN
        raise UserError(
            f"{name} acts otherwise than its policy: logits differ by {difference:.2g}, and "
            f"{n_apart} actions"
        )
    return difference.item()


def require(*names: str) -> list:
    """Returns modules of the extra `export`. Raises UserError if one is missing."""
    try:
        return [importlib.import_module(name) for name in names]
    except ImportError as error:
        cure = f"pip install '{package.DISTRIBUTION}[export]'"
        raise UserError(f"format=onnx needs {error.name}: {cure}") from None


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Leaves out what exporters say of packages that are not needed."""
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
