"""Explorer with PufferLib 3.0's trainer, `pufferlib.pufferl.PuffeRL`, and its LSTM policy.

Recipe: PufferLib's default settings, except 4 minibatches of 32 steps, and Adam instead of Muon,
which needs another package. `models.Default` in `models.LSTMWrapper`: a linear encoder, an LSTM of
256 units, actor and critic linear; TF32 matrix products, or bfloat16 by autocast. Prioritised
minibatches and V-trace's advantages are its own. Observations stay on the GPU; actions pass through
the host, as its trainer does it.
"""

import ast
import configparser
import os
import sys
import tempfile
import types
from pathlib import Path

import explorer
import gymnasium
import numpy as np
import torch


class VecEnv:
    """Explorer as PufferLib's vectorised environments are."""

    def __init__(self, env: explorer.Explorer):
        self.env, self.num_agents = env, env.n_lanes
        self.agents_per_batch, n_obs = env.n_lanes, env.obs.shape[1]
        box = gymnasium.spaces.Box(-np.inf, np.inf, (n_obs,), np.float32)
        self.single_observation_space = self.observation_space = box
        self.single_action_space = gymnasium.spaces.Discrete(env.n_actions)
        self.env_id, self.mask = np.arange(env.n_lanes), np.ones(env.n_lanes, bool)
        self.reward = torch.zeros(env.n_lanes, device=env.device)
        self.done = self.truncated = torch.zeros_like(self.reward, dtype=torch.bool)

    def async_reset(self, seed: int) -> None:
        """Does nothing: the environment was reset when it was made."""

    def recv(self) -> tuple:
        obs = self.env.obs
        return obs, self.reward, self.done, self.truncated, [], self.env_id, self.mask

    def send(self, actions: np.ndarray) -> None:
        actions = torch.as_tensor(actions, device=self.env.device)
        self.reward, self.done = self.env.step(actions)

    def close(self) -> None:
        pass


def import_pufferl(device: torch.device) -> types.ModuleType:
    """Imports the trainer. Builds its advantage kernel if PufferLib was installed without."""
    import pufferlib  # links a folder `resources` in the current one

    try:
        from pufferlib import _C  # noqa: F401
    except ImportError:
        from torch.utils import cpp_extension

        # where ninja is installed, which builds it
        os.environ["PATH"] += f"{os.pathsep}{Path(sys.executable).parent}"
        sources = Path(pufferlib.__file__).parent / "extensions"
        files = [sources / "pufferlib.cpp"]
        files += [sources / "cuda" / "pufferlib.cu"] if device.type == "cuda" else []
        kernel = cpp_extension.load("_C", [*map(str, files)], verbose=True)
        sys.modules["pufferlib._C"] = pufferlib._C = kernel
    from pufferlib import pufferl

    pufferl.ADVANTAGE_CUDA = device.type == "cuda"  # it looks for a compiler instead
    return pufferl


def config_of(given, package: Path, folder: str) -> dict:
    """Returns PufferLib's default settings with the benchmark's sizes."""
    parser = configparser.ConfigParser()
    parser.read(package / "config" / "default.ini")
    config = {}
    for name, value in parser["train"].items():
        try:
            config[name] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            config[name] = value
    n_samples = given.lanes * explorer.N_STEPS
    return config | dict(
        env="explorer",
        device=given.device,
        use_rnn=True,
        precision=given.precision,
        optimizer="adam",
        learning_rate=1e-3,
        adam_eps=1e-8,
        total_timesteps=10**12,
        bptt_horizon=explorer.N_STEPS,
        minibatch_size=n_samples // explorer.N_MINIBATCHES,
        max_minibatch_size=n_samples,
        data_dir=folder,
    )


def main() -> None:
    given = explorer.arguments()
    env = VecEnv(explorer.Explorer(given, privileged=False))
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        pufferl = import_pufferl(env.env.device)
        from pufferlib import models

        policy = models.Default(env, explorer.WIDTH)
        policy = models.LSTMWrapper(env, policy, explorer.WIDTH, explorer.WIDTH)
        package = Path(pufferl.__file__).parent
        trainer = pufferl.PuffeRL(config_of(given, package, folder), env, policy.to(given.device))
        clock = explorer.Clock(given)
        while not clock.is_done(trainer.global_step):
            trainer.evaluate()
            trainer.train()
        trainer.utilization.stop()


main()
