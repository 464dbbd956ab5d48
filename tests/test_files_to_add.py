"""Components are added to a copy of megastep in as few files as CONTRIBUTING.md says, and work."""

import json
import os
import re
import shutil
import subprocess
import sys
import textwrap

import pytest

from tests.helpers.pages import ROOT

#: {what: {file: text to add}}. A test, and a section of a page, are files more where MORE says so.
ADDED = {
    "environment, in PyTorch alone": {
        "megastep/envs/count.py": """
            import torch
            from megastep import arrdict, spaces

            __all__ = ["Count"]


            class Count:
                def __init__(self, n_envs=8, device="cpu", limit: int = 5):
                    self.n_envs, self.device, self.limit = n_envs, torch.device(device), limit
                    self.obs_space = spaces.MultiVector(1, 1)
                    self.action_space = spaces.MultiDiscrete(1, 2)
                    self.age = torch.zeros(n_envs, dtype=torch.int64)

                def world(self, reset):
                    ended, none = self.age >= self.limit, torch.zeros_like(reset)
                    obs, reward = self.age[:, None, None].float(), self.age.float()
                    return arrdict.arrdict(
                        obs=obs, reward=reward, reset=reset, terminal=none, truncated=ended
                    )

                def reset(self):
                    self.age.zero_()
                    return self.world(torch.ones(self.n_envs, dtype=torch.bool))

                def step(self, decision):
                    reset = self.age >= self.limit
                    self.age.add_(1).masked_fill_(reset, 0)
                    return self.world(reset)
            """
    },
    "source of floor plans": {
        "megastep/geometries/sources.py": """


            def rooms(n=1, split="training", seed=1, width: float = 3.0):
                return box(n, split, seed, width)


            __all__ += ["rooms"]
            """
    },
    "learner": {
        "agents/algorithms/slow.py": """
            from megastep.agents.algorithms.ppo import PPO


            class Slow(PPO):
                def __init__(self, policy, *, patience: int = 3, **kwargs):
                    super().__init__(policy, **kwargs)
            """
    },
    "recurrent core": {
        "agents/networks/leaky.py": """
            from megastep.agents.networks.mingru import MinGRU


            class Leaky(MinGRU):
                pass
            """,
        "agents/networks/cores.py": """

            CORES["leaky"] = "megastep.agents.networks.leaky:Leaky"
            """,
    },
    "logger": {
        "agents/training/loggers/memo.py": """
            class Memo:
                def __init__(self, folder, word: str = "memo"):
                    self.file = open(folder / "memo.txt", "w")
                    self.word = word

                def write(self, step, values):
                    print(self.word, step, file=self.file)

                def close(self):
                    self.file.close()
            """
    },
    "command": {
        "agents/cli/greet.py": """
            from megastep.agents.cli.command import Command


            def run(name: str):
                print("hello", name)


            COMMAND = Command("greet", run, "Says hello.")
            main = COMMAND.main
            """,
        "agents/cli/entry.py": """

            COMMANDS["greet"] = "says hello"
            """,
    },
}
#: Its test, which cores share; a page's section.
MORE = {"environment, in PyTorch alone": 2, "learner": 2}
IN_ONE_PROCESS = """
import sys
from megastep.agents.cli import entry
for line in sys.argv[1:]:
    name, *words = line.split()
    assert entry.run_command(name, words) == 0
"""


def test_contributing_counts_the_files():
    table = re.findall(
        r"^\| ([a-z, A-Z]+) \| (\d) \| ", (ROOT / "CONTRIBUTING.md").read_text(), re.M
    )
    assert {what: int(n) for what, n in table} == {
        what: len(files) + MORE.get(what, 1) for what, files in ADDED.items()
    }


@pytest.mark.slow
def test_one_of_each_is_added_to_a_copy(tmp_path):
    for folder in ("agents", "megastep", "configs", "tests"):
        ignored = shutil.ignore_patterns("__pycache__", "*.npz" if folder == "agents" else "-")
        shutil.copytree(ROOT / folder, tmp_path / folder, symlinks=True, ignore=ignored)
    for name in ("train.py", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path)
    for files in ADDED.values():
        for name, text in files.items():
            with open(tmp_path / name, "a") as file:
                file.write(textwrap.dedent(text))

    def run(*words):
        command = [sys.executable, *words]
        environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
        options = dict(cwd=tmp_path, env=environment, check=True, text=True, timeout=300)
        return subprocess.run(command, stdout=subprocess.PIPE, **options).stdout

    chosen = "env=count env.limit=4 env.n_envs=8 learner=slow learner.patience=2 agent.core=leaky"
    chosen += " agent.width=8 logger=memo logger.memo.word=said samples=256 folder=run"
    chosen += " logging.every=1"
    words = "env=minimal geometry=rooms geometry.width=4 env.n_envs=4 env.res=8 device=cpu"
    commands = "greet name=you", f"train {chosen} device=cpu", f"train {words} dry_run=true"
    text = run("-c", IN_ONE_PROCESS, *commands)
    assert text.startswith("hello you\n") and "environments" in text.rpartition("trained")[2]
    config = json.loads(next((tmp_path / "run").glob("checkpoints/*/config.json")).read_text())
    train = config["train"]
    assert (train["env"]["limit"], train["learner"]["patience"]) == (4, 2)
    assert (tmp_path / "run" / "memo.txt").read_text().startswith("said ")
    # tests over what exists take what is new
    of_all = "every_group_member and (learner or logger) or loggers or help_lists"
    run("-m", "pytest", "-q", "-n", "0", "-m", "", "-k", of_all, "tests/cli/test_config.py")
