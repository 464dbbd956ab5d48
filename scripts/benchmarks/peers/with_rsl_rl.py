"""Explorer with rsl_rl's trainer, `rsl_rl.runners.OnPolicyRunner`.

Recipe: rsl_rl's default settings of PPO with Adam, except one epoch of 4 minibatches and a constant
learning rate. The actor is its `RNNModel`: an LSTM of 256 units, then a layer of 256 units. The
critic is its `MLPModel` with two layers of 256 units, and also sees privileged observations.
Observations are normalised. float32 without TF32, or bfloat16 by autocast in updates. Reports and
checkpoints are on.
"""

import os
import tempfile

os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")  # its logger also works without git

import explorer
import torch
from rsl_rl.env import VecEnv
from rsl_rl.modules.distribution import Distribution
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict


class Env(VecEnv):
    """Explorer as rsl_rl's environments are. Actions are one-hot, (B, n)."""

    def __init__(self, env: explorer.Explorer):
        self.env, self.num_envs, self.num_actions = env, env.n_lanes, env.n_actions
        self.device, self.cfg, self.max_episode_length = env.device, {}, 10_000
        self.episode_length_buf = torch.zeros(env.n_lanes, dtype=torch.long, device=env.device)

    def get_observations(self) -> TensorDict:
        # copies, as the next step overwrites them
        obs = {"policy": self.env.obs.clone(), "privileged": self.env.privileged.clone()}
        return TensorDict(obs, batch_size=[self.num_envs])

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        reward, done = self.env.step(actions.argmax(-1))
        return self.get_observations(), reward, done.long(), {}


class OneHot(Distribution):
    """A categorical distribution over one-hot actions; rsl_rl has continuous ones only."""

    def update(self, mlp_output: torch.Tensor) -> None:
        self._now = torch.distributions.OneHotCategorical(logits=mlp_output, validate_args=False)

    def sample(self) -> torch.Tensor:
        return self._now.sample()

    def deterministic_output(self, mlp_output: torch.Tensor) -> torch.Tensor:
        return mlp_output

    @property
    def input_dim(self) -> int:
        return self.output_dim

    @property
    def mean(self) -> torch.Tensor:
        return self._now.mean

    @property
    def std(self) -> torch.Tensor:
        return self._now.stddev

    @property
    def entropy(self) -> torch.Tensor:
        return self._now.entropy()

    @property
    def params(self) -> tuple[torch.Tensor, ...]:
        return (self._now.logits,)

    def log_prob(self, outputs: torch.Tensor) -> torch.Tensor:
        return self._now.log_prob(outputs)


def config_of(precision: str) -> dict:
    width = explorer.WIDTH
    normalised = {"obs_normalization": True, "activation": "elu"}
    return dict(
        num_steps_per_env=explorer.N_STEPS,
        save_interval=50,
        obs_groups={"actor": ["policy"], "critic": ["policy", "privileged"]},
        algorithm=dict(
            class_name="PPO",
            num_learning_epochs=1,
            num_mini_batches=explorer.N_MINIBATCHES,
            schedule="fixed",
            use_mixed_precision=precision == "bfloat16",
        ),
        actor=dict(
            class_name="RNNModel",
            rnn_type="lstm",
            rnn_hidden_dim=width,
            hidden_dims=[width],
            distribution_cfg={"class_name": OneHot},
            **normalised,
        ),
        critic=dict(class_name="MLPModel", hidden_dims=[width, width], **normalised),
    )


def main() -> None:
    given = explorer.arguments()
    env = Env(explorer.Explorer(given, privileged=True))
    clock, n_samples = explorer.Clock(given), 0
    with tempfile.TemporaryDirectory() as folder:
        runner = OnPolicyRunner(env, config_of(given.precision), folder, given.device)
        learn = runner.alg.update

        def update():
            """Ends the loop between two iterations, which has no hook."""
            nonlocal n_samples
            losses = learn()
            n_samples += given.lanes * explorer.N_STEPS
            if clock.is_done(n_samples):
                raise StopIteration
            return losses

        runner.alg.update = update
        try:
            runner.learn(10**9)
        except StopIteration:
            pass


main()
