"""A policy as a file of another runtime acts as it does in megastep."""

import json
from pathlib import Path

import pytest
import torch

from megastep import spaces
from megastep.agents.cli import export, train
from megastep.agents.errors import UserError
from megastep.agents.export import runtimes
from megastep.agents.export.runtimes import Step
from megastep.agents.networks.fused import plain_operations
from megastep.agents.networks.policy import Policy
from megastep.arrdict import arrdict
from tests.helpers.tiny import TINY

IMAGE, VECTOR = spaces.MultiImage(1, 3, 1, 64), spaces.MultiVector(1, 3)
MANY = {"rgb": IMAGE, "self": {"imu": VECTOR, "id": spaces.MultiDiscrete(2, 4)}}
MOVES = {"move": spaces.MultiDiscrete(2, 7), "say": spaces.MultiDiscrete(1, 3)}
BOUNDED = spaces.MultiContinuous(1, 2, -2.0, (1.0, 3.0))
#: Every core, output and encoder: spaces, and settings of the policy. In the last two, with masks.
KINDS = {
    "lstm": (MANY, MOVES, {}),
    "gru": (IMAGE, BOUNDED, dict(core="gru", encoder="conv")),
    "mingru": (MANY, BOUNDED, dict(core="mingru", layers=2, continuous="beta", encoder="cnn")),
    "none": (VECTOR, spaces.MultiDiscrete(1, 5), dict(core="none", output="duelling")),
    "masked": (VECTOR, MOVES, dict(core="gru")),
}
MASKED = {"none": spaces.MultiDiscrete(1, 5), "masked": {"move": MOVES["move"]}}


class Noise:
    """Lanes that observe noise, may take some actions, and whose episodes end now and then."""

    n_envs, device = 3, "cpu"

    def __init__(self, obs_space, masked=None):
        self.obs_space, self.masked = obs_space, masked
        self.generator = torch.Generator().manual_seed(1)

    def reset(self):
        return self.step(None)

    def step(self, decision):
        def draw(space):
            if isinstance(space, spaces.MultiDiscrete):
                shape = self.n_envs, *space.shape
                return torch.randint(space.n_actions, shape, generator=self.generator)
            if getattr(space, "dtype", None) == torch.uint8:  # categories
                shape = self.n_envs, *space.shape
                return torch.randint(12, shape, generator=self.generator, dtype=torch.uint8)
            return 3 * torch.randn(self.n_envs, *space.shape, generator=self.generator) + 1

        def allow(space):
            shape = self.n_envs, *space.shape, space.n_actions
            mask = torch.rand(shape, generator=self.generator) < 0.5
            return mask | ~mask.any(-1, keepdim=True)

        reset = torch.rand(self.n_envs, generator=self.generator) < 0.05
        world = arrdict(obs=spaces.map(draw, self.obs_space), reset=reset)
        if self.masked is not None:
            world["mask"] = spaces.map(allow, self.masked)
            if decision is not None:
                masks = spaces.leaves(self.mask)
                for path, actions in spaces.leaves(decision["actions"]).items():
                    if path in masks:
                        assert masks[path].gather(-1, actions[..., None]).all()
            self.mask = world["mask"]
        return world


def made(kind):
    """Returns a policy with weights that matter and statistics, and the step it exports."""
    obs_space, action_space, options = KINDS[kind]
    policy = Policy(obs_space, action_space, width=32, **options)
    env = Noise(obs_space, MASKED.get(kind))
    for _ in range(3):
        policy.update_stats(env.step(None)["obs"])
    with torch.no_grad():
        for weight in policy.output.parameters():
            weight.mul_(20)
    return policy, env, Step(policy, env.reset())


@pytest.mark.parametrize("kind", KINDS)
def test_a_step_is_the_policys_greedy_one(kind):
    policy, env, step = made(kind)

    def plain(inputs):
        with plain_operations():
            return step(*inputs)

    assert runtimes.compare(step, plain, policy, env, kind, n_steps=30) < 1e-4


def test_comparisons_see_a_hidden_state_that_is_never_reset():
    policy, env, step = made("gru")

    def never(inputs):
        *obs, reset, state = inputs
        return step(*obs, torch.zeros_like(reset), state)

    with pytest.raises(UserError, match="acts otherwise than its policy"):
        runtimes.compare(step, never, policy, env, "x.onnx", n_steps=100)


@pytest.mark.nightly
@pytest.mark.parametrize("kind", KINDS)
def test_files_act_as_the_policy_for_1000_steps(kind, tmp_path):
    policy, env, step = made(kind)
    runtimes.save(step, tmp_path / "a.pt2")
    runtimes.compare(step, runtimes.runner(tmp_path / "a.pt2"), policy, env, "a")
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxscript")
    pytest.importorskip("onnxruntime")
    runtimes.save(step, tmp_path / "a.onnx")
    runtimes.compare(step, runtimes.runner(tmp_path / "a.onnx"), policy, env, "a")
    model = onnx.load(tmp_path / "a.onnx")
    assert model.opset_import[0].version >= 18
    assert [port.name for port in model.graph.input] == [port.name for port in step.inputs]
    (ports,) = [p.value for p in model.metadata_props if p.key == "megastep"]
    assert json.loads(ports)["outputs"][0]["name"] == step.outputs[0].name


@pytest.mark.nightly
def test_an_agent_of_gymnasium_is_exported(here):
    """With the normalisation of observations inside, and named after its spaces."""
    for name in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(name)
    words = [*TINY[2:3], *TINY[4:], "env=gymnasium", "env.id=CartPole-v1", "samples=256"]
    assert train.main([*words, "env.wrappers=[{name:frame_stack,n:2}]", "folder=run"]) == 0
    assert export.main(["run=run", "format=onnx", "file=a.onnx"]) == 0
    import onnxruntime

    session = onnxruntime.InferenceSession("a.onnx")
    inputs = {port.name: port.shape[1:] for port in session.get_inputs()}
    assert inputs == {"obs": [1, 8], "reset": [], "state.0": [8], "state.1": [8]}
    about = json.loads(Path("a.json").read_text())
    assert {port["name"]: port["shape"] for port in about["inputs"]} == inputs
    assert about["steps_per_second"] == 50 and "robot" not in about


@pytest.mark.nightly
def test_an_agent_that_plays_in_no_homes_is_exported(here):
    words = ["env=hideandseek", "env.n_envs=4", "env.res=8", "env.subsample=1", "geometry.n=4"]
    assert train.main([*TINY[2:3], *TINY[4:], *words, "samples=256", "folder=run"]) == 0
    assert export.main(["run=run", "format=torch"]) == 0


class Odd(torch.nn.Module):
    """A core that asks a tensor for its value, which no graph has."""

    def __init__(self, width):
        super().__init__()

    def initial(self, n_lanes, device=None):
        return arrdict(total=torch.zeros(n_lanes, device=device))

    def forward(self, x, reset, state):
        if x.sum().item() > 1e9:
            x = x + 1
        return x, state


def test_a_core_that_cannot_be_exported_is_one_sentence(tmp_path):
    policy = Policy(VECTOR, MOVES, width=8, core=f"{__name__}:Odd")
    with pytest.raises(UserError, match=r"^mine cannot be exported: .*; format=safetensors"):
        runtimes.save(Step(policy, Noise(VECTOR).reset()), tmp_path / "a.pt2", "mine")
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    "words, text",
    [
        (["format=onnx"], "run: is missing"),
        (["run=explorer_anywhere"], "format: is missing"),
        (["run=explorer_anywhere", "format=onx"], "format: 'onx' is unknown; did you mean onnx"),
        (["run=nowhere", "format=onnx"], "nowhere is neither a run folder nor a pretrained agent"),
        (["run=explorer_anywhere", "format=onnx", "file=a.pt"], "file=a.pt must end with .onnx"),
    ],
)
def test_bad_words_are_one_sentence(words, text, here, capsys):
    assert export.main(words) == 2 and text in capsys.readouterr().err
    assert not any(here.iterdir())
