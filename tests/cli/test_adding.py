"""Extending megastep from outside the repository, through the command line.

Also tests the errors for classes that cannot be used.
"""

import importlib
import json
import os
import pathlib
import shutil
import sys
import textwrap

import pytest

from megastep.agents.cli import evaluate, record, train
from megastep.agents.factory.components import kind_of
from megastep.agents.runs import checkpoint, folders, json_lines
from tests.helpers import tiny

ROOT = pathlib.Path(__file__).parents[2]
SMALL = [word for word in tiny.TINY if not word.startswith(("env=", "env.res", "geometry"))]
MINIMAL = ["env=minimal", "env.res=8", "geometry=box"]
RUN = [*SMALL, "samples=64", "logging.every=1"]

COUNTER = '''
from typing import Annotated

import torch
from pydantic import Field

from megastep import arrdict, spaces


class Counter:
    """A counter: action 1 counts up and gives reward 1. Truncated after `limit` steps."""

    action_space = spaces.MultiDiscrete(1, 2)

    def __init__(
        self,
        n_envs: int,
        *,
        seed: int = 1,
        device: torch.device | str | None = None,
        limit: Annotated[int, Field(ge=1, le=100)] = 6,
        sizes: tuple[int, ...] = (1, 2),
    ):
        self.n_envs, self.device = n_envs, torch.device("cpu" if device is None else device)
        self.limit, self.sizes = limit, sizes
        self.obs_space = spaces.MultiVector(1, 2)
        self.age = torch.zeros(n_envs, dtype=torch.int32, device=self.device)
        self.count = torch.zeros(n_envs, device=self.device)

    def reset(self):
        everyone = torch.ones(self.n_envs, dtype=torch.bool, device=self.device)
        return self._world(everyone, torch.zeros_like(self.count))

    def step(self, decision):
        return self._world(self.age >= self.limit, decision.actions[:, 0].float())

    def _world(self, reset, up):
        reward = up.masked_fill(reset, 0.0)
        self.age.add_(1).masked_fill_(reset, 0)
        self.count.add_(reward).masked_fill_(reset, 0.0)
        return arrdict.arrdict(
            obs=torch.stack([self.count, self.age.float()], -1)[:, None],
            reward=reward,
            reset=reset,
            terminal=torch.zeros_like(reset),
            truncated=self.age >= self.limit,
        )

    def state(self, e=0):
        return arrdict.arrdict(count=self.count[e].clone())

    @classmethod
    def plot_state(cls, state):
        from matplotlib.figure import Figure

        figure = Figure(figsize=(2, 2))
        figure.text(0.5, 0.5, str(state.count))
        return figure
'''


@pytest.fixture
def outside(tmp_path, monkeypatch):
    """Changes to an empty folder. Returns a function that writes files there."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(ROOT), *sys.path])
    before = set(sys.modules)

    def write(files):
        for name, text in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(textwrap.dedent(text))
        importlib.invalidate_caches()

    yield write
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", None)).startswith(str(tmp_path)):
            del sys.modules[name]


def saved():
    """Returns the checkpoint of the latest run."""
    return checkpoint.load_latest(folders.find("latest") / "checkpoints")


def leftovers():
    """Returns the run folders."""
    return [path for path in pathlib.Path("runs").glob("*") if path.is_dir()]


# ---- One test per row of the table ----


def test_custom_environment(outside, capsys):
    outside({"board/__init__.py": "", "board/counter.py": COUNTER})
    name = "board.counter:Counter"
    assert train.main([f"env={name}", *RUN, "env.limit=9", "env.sizes=[3]"]) == 0
    config = saved().config["train"]["env"]
    assert config == {"name": name, "n_envs": 4, "limit": 9, "sizes": [3], "wrappers": []}
    assert "-counter-" in leftovers()[0].name
    assert train.main(["resume=latest", "samples=128"]) == 0
    assert saved().step == 128
    assert evaluate.main(["run=latest", "episodes=8"]) == 0
    (table,) = (leftovers()[0] / "evaluations").glob("*.json")
    rows = json.loads(table.read_text())["rows"]
    assert [row["length"] for row in rows] == [9, 9] and all(0 <= r["return"] <= 9 for r in rows)
    assert record.main(["run=latest", "steps=3"]) == 0
    assert record.main([f"env={name}", "steps=3", "device=cpu", "file=random.mp4"]) == 0
    assert pathlib.Path("random.mp4").exists()
    sizes = f"-m env={name} env.limit=3,4".split()
    capsys.readouterr()
    assert train.main([*sizes, *RUN]) == 0 and capsys.readouterr().out.count("done") >= 2


def test_custom_learner(outside, capsys):
    """REINFORCE without a baseline, with its own storage and estimate of memory."""
    learner = '''
        from typing import Annotated

        import torch
        from pydantic import Field

        from megastep.agents.algorithms.nonfinite import NonFiniteCheck
        from megastep.agents.storage.collector import Collector
        from megastep.agents.storage.rollout import Rollout
        from megastep.types import n_lanes


        class Reinforce:
            """Follows the rewards of a rollout, discounted by gamma."""

            def __init__(self, policy, *, lr: Annotated[float, Field(gt=0)] = 0.1, length: int = 5):
                self.policy, self.lr, self.length = policy, lr, length
                self.check = NonFiniteCheck(policy.device)
                self.optimizer = torch.optim.SGD(policy.parameters(), lr)

            def collector(self, env):
                lanes, policy = n_lanes(env), self.policy
                spaces = env.obs_space, env.action_space
                rollout = Rollout(self.length, lanes, *spaces, policy.initial(lanes), env.device)
                return Collector(env, policy, rollout)

            def bytes_per_env(self, env):
                return 1000.0 * self.length

            def set_lr(self, lr):
                for group in self.optimizer.param_groups:
                    group["lr"] = lr

            def update(self, rollout):
                is_fine = self.check(rollout.floats())
                out = self.policy.unroll(rollout.obs, rollout.starts, rollout.state)
                logprobs = self.policy.output.logprob(out.logits[:-1], rollout.actions)
                to_go = rollout.reward.flip(0).cumsum(0).flip(0)
                loss = -(logprobs * to_go).mean()
                self.optimizer.zero_grad()
                loss.backward()
                self.optimizer.step()
                self.check.count(~is_fine)
                return {"loss/policy": loss.detach()}

            def state_dict(self):
                return dict(generator=self.policy.generator.state_dict())

            def load_state_dict(self, state):
                self.policy.generator.load_state_dict(state["generator"], self.policy.device)
        '''
    outside({"counter.py": COUNTER, "reinforce.py": learner})
    words = ["env=counter:Counter", *(w for w in SMALL if not w.startswith("learner."))]
    learner_words = ["learner=reinforce:Reinforce", "learner.lr=0.1", "learner.length=4"]
    learner_words += ["learner.anneal=never"]
    assert train.main([*words, *learner_words, "samples=48", "logging.every=1"]) == 0
    config = saved().config["train"]["learner"]
    assert config == {"name": "reinforce:Reinforce", "anneal": "never", "lr": 0.1, "length": 4}
    rows = json_lines.read(leftovers()[0] / "metrics.jsonl")
    assert [row["samples"] for row in rows] == [16, 32, 48] and "loss/policy" in rows[-1]
    assert train.main(["resume=latest", "samples=64"]) == 0
    assert evaluate.main(["run=latest", "episodes=4"]) == 0
    capsys.readouterr()
    many = [*words, *learner_words, "env.n_envs=100", "folder=many", "learner.length=1000000000"]
    assert train.main(many) == 2  # 100 times 1e12 bytes, by its own estimate
    assert "100 environments" in capsys.readouterr().err and not pathlib.Path("many").exists()


MEAN = '''
    import torch
    from torch import nn

    from megastep.arrdict import arrdict


    class Mean(nn.Module):
        """A layer on the sum of the inputs since the last reset."""

        def __init__(self, width):
            super().__init__()
            self.layer = nn.Linear(width, width)

        def initial(self, n_lanes, device=None):
            return arrdict(total=torch.zeros(n_lanes, self.layer.in_features, device=device))

        def forward(self, x, reset, state):
            total, outputs = state.total, []
            for t in range(len(x)):
                total = total.masked_fill(reset[t, :, None], 0.0) + x[t]
                outputs.append(self.layer(total))
            return torch.stack(outputs), arrdict(total=total)
    '''


# ---- Classes that cannot be used ----


def refused(capsys, *words, main=train.main):
    """Returns the error of a command, which must leave no run folder."""
    capsys.readouterr()
    assert main([*words]) == 2
    assert not leftovers()
    return capsys.readouterr().err


@pytest.mark.parametrize(
    "words, sentence",
    [
        (["env=nowhere:Counter"], "env: nowhere:Counter cannot be imported (No module named"),
        (["env=broken:Counter"], "env: broken:Counter cannot be imported (SyntaxError: "),
        (["env=needs:Counter"], "cannot be imported (No module named 'nothing_of_this_name')"),
        (["env=counter:Conter"], "counter has no Conter; did you mean Counter?"),
        (["env=counter:torch"], "counter:torch is a module, neither a class nor a function"),
        (["env=counter:none"], "counter has no none"),
        (["env=counter:Bare"], "counter:Bare cannot be used: it has no argument n_envs"),
        (["env=counter:Unread"], "cannot be used: its arguments cannot be read: name 'Nowhere'"),
        (["env=counter"], "env: 'counter' is unknown; "),
        (
            ["env=counter:Counter", "env.limit=0"],
            "env.limit: 0 is out of range: allowed is at least",
        ),
        (["env=counter:Counter", "env.limit=x"], "env.limit: expected an integer, got 'x'"),
        (["env=counter:Counter", "env.sizes=3"], "env.sizes: expected a list, got 3"),
        (["env=counter:Counter", "env.limt=3"], "env.limt: no such key; did you mean env.limit?"),
        (["env=counter:Counter", "env.seed=3"], "env.seed: no such key"),
        (["geometry=counter:rooms"], "geometry: counter:rooms cannot be imported"),
        (["learner=counter:Counter"], "counter:Counter cannot be used: it has no argument policy"),
        (["learner=counter:Idle"], "counter:Idle is not a learner: it has no collector: "),
        (["agent.core=lstmm"], "agent.core: 'lstmm' is unknown; did you mean lstm?"),
        (["agent.core=mingu"], "agent.core: 'mingu' is unknown; did you mean mingru?"),
        (["agent.layers=0"], "agent.layers: 0 is out of range: allowed is at least 1"),
        (["agent.core=counter:torch"], "agent.core: counter:torch is a module"),
        (["agent.encoder=counter:nothing"], "agent.encoder: counter:nothing cannot be imported"),
    ],
)
def test_unusable_class_error(outside, capsys, words, sentence):
    more = """

        class Bare:
            pass


        class Unread:
            def __init__(self, n_envs: int, x: "Nowhere" = 1):
                pass


        class Idle:
            def __init__(self, policy):
                pass
        """
    broken = {"broken.py": "def f(:\n", "needs.py": "import nothing_of_this_name\n"}
    outside({"counter.py": COUNTER + textwrap.dedent(more)} | broken)
    error = refused(capsys, *(word for word in SMALL if not word.startswith("learner.")), *words)
    assert sentence in error, error


@pytest.mark.parametrize(
    "change, clause",
    [
        (("limit, self.sizes = limit", "fps, self.sizes = 0"), "fps must be a positive number"),
        (("reward=reward,", "reward=reward.double(),"), "reward must be torch.float32"),
        (("torch.zeros_like(reset),", "self.age >= self.limit,"), "exclude each other"),
        (("[:, None],", ","), "obs must be "),
        (("reset=reset,", "reset=reset, metrics=dict(up=up[:1]),"), "metrics.up must be torch.fl"),
        (("reset=reset,", ""), "the world has no reset"),
    ],
)
def test_environment_contract_error_names_the_clause(outside, capsys, change, clause):
    assert change[0] in COUNTER
    outside({"counter.py": COUNTER.replace(*change)})
    error = refused(capsys, "env=counter:Counter", *SMALL)
    assert "Counter breaks the contract: " in error and clause in error, error
    assert "counter:Counter" in error and len(error.splitlines()) == 1


@pytest.mark.parametrize(
    "change, clause",
    [
        (("masked_fill(reset[t, :, None], 0.0)", "clone()"), "reset must clear"),
        (("self.layer(total)", "self.layer(total)[:, :1]"), "(T, B, width)"),
        (("arrdict(total=total)", "arrdict()"), "keep its keys and shapes"),
        (("def initial", "def start"), "initial(B, device)"),
    ],
)
def test_core_contract_error_names_the_clause(outside, capsys, change, clause):
    assert change[0] in MEAN
    outside({"mean.py": MEAN.replace(*change)})
    error = refused(capsys, *MINIMAL, *SMALL, "agent.core=mean:Mean")
    assert "mean:Mean" in error and clause in error, error


def test_encoder_contract_error(outside, capsys):
    text = "from torch import nn\n\n\nclass Half(nn.Flatten):\n    n_features = 3\n\n"
    outside({"half.py": text + "    def __init__(self, space):\n        super().__init__(-4)\n"})
    error = refused(capsys, *MINIMAL, *SMALL, "agent.encoder=half:Half")
    assert "half:Half breaks the contract of encoders" in error and "(3, 3), not (3, 24)" in error


def test_missing_class_of_a_checkpoint(outside, capsys):
    outside({"counter.py": COUNTER})
    assert train.main(["env=counter:Counter", *RUN]) == 0
    os.remove("counter.py")
    del sys.modules["counter"]
    shutil.rmtree("__pycache__", ignore_errors=True)
    kind_of.cache_clear()
    for main, words in (
        (evaluate.main, ["run=latest"]),
        (record.main, ["run=latest"]),
        (train.main, ["resume=latest", "samples=128"]),
    ):
        capsys.readouterr()
        assert main(words) == 2
        assert "counter:Counter cannot be imported (No module named" in capsys.readouterr().err
    assert saved().step == 64


# ---- init, and recording without a run ----


def test_init_takes_environment_geometry_and_agent_unless_typed(outside):
    limit = "    def __init__(self, n_envs, geometries, seed=1, device=None, limit: int = 6):\n"
    roomy = f"\n\nclass Roomy(Counter):\n{limit}"
    roomy += "        super().__init__(n_envs, seed=seed, device=device, limit=limit)\n"
    outside({"counter.py": COUNTER + roomy})
    own = ["env=counter:Roomy", "env.limit=7", "agent.core=gru", "agent.critic=plain"]
    assert train.main([*RUN, *own, "geometry=box", "geometry.width=6", "folder=first"]) == 0
    common = [w for w in RUN if not w.startswith(("agent.", "env."))]
    assert train.main([*common, "init=first", "env.n_envs=8", "folder=second"]) == 0
    config = checkpoint.load_latest("second/checkpoints").config["train"]
    expected = {"name": "counter:Roomy", "n_envs": 8, "limit": 7, "wrappers": []}
    assert config["env"] == expected
    assert config["agent"]["core"] == "gru" and config["agent"]["width"] == 8
    box = {"name": "megastep.geometries.sources:box", "n": 1, "seed": 1, "width": 6.0}
    assert config["geometry"] == box
    words = ["init=first", "env=counter:Roomy", "env.n_envs=4", "geometry=column"]
    assert train.main([*common, *words, "folder=third"]) == 0
    config = checkpoint.load_latest("third/checkpoints").config["train"]
    assert config["env"]["limit"] == 6 and config["geometry"]["name"].endswith(":column")
