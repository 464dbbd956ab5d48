"""Trains with other libraries on megastep's environments, and compares with random actions.

    pip install 'megastep-flatland[sb3,torchrl,rsl-rl,skrl]'
    python scripts/examples/other_libraries.py sb3 sb3_recurrent torchrl rsl_rl skrl
    python scripts/examples/other_libraries.py rsl_rl --device cuda --scale 10

Each trains for its budget of samples, times `--scale`, and then plays one episode in each of 512
environments: Pong, by the points won, or PointGoal in a square room with continuous actions, by
success. Printed are the means with a 95 % interval, and those of random actions.
"""

import argparse
import time

import megastep.adapters  # noqa: F401  # isort: skip  (before torch)

import torch
from torch import nn

from megastep import adapters, envs, spaces, toys

N_EPISODES = 512
#: Samples of each library's training.
BUDGETS = dict(sb3=500_000, sb3_recurrent=120_000, torchrl=500_000, rsl_rl=1_000_000, skrl=500_000)


def pong(n_envs, device, seed=1):
    return envs.Pong(n_envs, device=device, seed=seed)


def pointgoal(n_envs, device, seed=1):
    settings = dict(control="continuous", privileged=True, limit=100, furthest=4.0)
    return envs.PointGoal(n_envs, [toys.box()], device=device, seed=seed, **settings)


def score(env, act, metric, seed=1000):
    """Returns (mean, half of a 95 % interval) of a metric over the first episode of each lane.

    Args:
        act: takes observations (B, D) float32 and flags (B,), True at an episode's first
            observation; returns actions.
    """
    vector = adapters.VectorEnv(env, to_numpy=False)
    obs, _ = vector.reset(seed=seed)
    n, device = vector.num_envs, vector.device
    starts, found = torch.ones(n, dtype=torch.bool, device=device), torch.full((n,), torch.nan)
    with torch.no_grad():
        while found.isnan().any():
            actions = act(flat(obs), starts)
            obs, _, terminated, truncated, infos = vector.step(actions)
            ended = (terminated | truncated) & ~starts
            values = infos[metric].cpu()
            found = torch.where(ended.cpu() & found.isnan(), values, found)
            starts = terminated | truncated
    return found.mean().item(), 1.96 * (found.std() / n**0.5).item()


def flat(obs):
    """Observations, a tensor or a dict of them, as (B, D) float32."""
    return torch.cat([leaf.flatten(1).float() for leaf in spaces.leaves(obs).values()], 1)


def train_sb3(samples, device):
    from stable_baselines3 import PPO

    env = adapters.SB3VecEnv(pong(64, device))
    settings = dict(n_steps=64, batch_size=1024, n_epochs=4, learning_rate=1e-3, ent_coef=0.01)
    model = PPO("MlpPolicy", env, seed=1, device="cpu", **settings)
    model.learn(samples)
    return lambda obs, starts: torch.as_tensor(model.predict(obs.cpu().numpy())[0])


def train_sb3_recurrent(samples, device):
    from sb3_contrib import RecurrentPPO

    env = adapters.SB3VecEnv(pong(64, device))
    settings = dict(n_steps=32, batch_size=512, n_epochs=4, learning_rate=1e-3, ent_coef=0.01)
    network = dict(net_arch=[64], lstm_hidden_size=64)
    model = RecurrentPPO(
        "MlpLstmPolicy", env, seed=1, device="cpu", policy_kwargs=network, **settings
    )
    model.learn(samples)
    state = None

    def act(obs, starts):
        nonlocal state
        actions, state = model.predict(obs.cpu().numpy(), state, episode_start=starts.cpu().numpy())
        return torch.as_tensor(actions)

    return act


def train_torchrl(samples, device, n_envs=64, n_steps=64, width=64):
    """PPO whose actor has an LSTM."""
    from tensordict.nn import TensorDictModule, TensorDictSequential
    from torchrl.collectors import Collector
    from torchrl.envs import InitTracker, TransformedEnv
    from torchrl.modules import LSTMModule, ProbabilisticActor, ValueOperator, set_recurrent_mode
    from torchrl.objectives import ClipPPOLoss
    from torchrl.objectives.value import GAE

    torch.manual_seed(1)
    env = TransformedEnv(adapters.TorchRLEnv(pong(n_envs, device)), InitTracker())
    lstm = LSTMModule(input_size=width, hidden_size=width, in_key="embedded", out_key="features")
    env.append_transform(lstm.make_tensordict_primer())
    embed = nn.Sequential(nn.Linear(8, width), nn.Tanh())
    body = TensorDictSequential(
        TensorDictModule(embed, in_keys=["observation"], out_keys=["embedded"]),
        lstm,
        TensorDictModule(nn.Linear(width, 3), in_keys=["features"], out_keys=["logits"]),
    )
    actor = ProbabilisticActor(
        body,
        in_keys=["logits"],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
    ).to(device)
    critic = nn.Sequential(nn.Linear(8, width), nn.Tanh(), nn.Linear(width, 1))
    critic = ValueOperator(critic, in_keys=["observation"]).to(device)
    loss = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=0.01, critic_coeff=0.5)
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=True)
    optimizer = torch.optim.Adam(loss.parameters(), 1e-3)
    per_batch = n_envs * n_steps
    collector = Collector(
        env,
        actor,
        frames_per_batch=per_batch,
        total_frames=per_batch * max(1, samples // per_batch),
        device=device,
    )
    for batch in collector:
        for _ in range(4):
            with torch.no_grad():
                advantage(batch)
            for lanes in torch.randperm(n_envs).chunk(4):
                with set_recurrent_mode(True):
                    parts = loss(batch[lanes.to(device)])
                total = sum(part for key, part in parts.items() if key.startswith("loss_"))
                optimizer.zero_grad()
                total.backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimizer.step()
    collector.shutdown()
    state = None

    def act(obs, starts):
        nonlocal state
        cell = lstm.lstm
        x = embed(obs)[:, None]
        zeros = torch.zeros(1, len(obs), width, device=obs.device)
        state = (zeros, zeros) if state is None else state
        state = tuple(part.masked_fill(starts[None, :, None], 0) for part in state)
        features, state = cell(x, state)
        return torch.distributions.Categorical(logits=body[-1].module(features[:, 0])).sample()

    return act


def train_rsl_rl(samples, device, n_envs=256, n_steps=32):
    from rsl_rl.runners import OnPolicyRunner

    network = dict(hidden_dims=[128, 128], activation="elu", obs_normalization=True)
    gaussian = dict(class_name="GaussianDistribution", init_std=1.0, std_type="scalar")
    settings = dict(
        num_steps_per_env=n_steps,
        save_interval=10**9,
        obs_groups=dict(actor=["policy"], critic=["critic"]),
        actor=dict(class_name="MLPModel", distribution_cfg=gaussian, **network),
        critic=dict(class_name="MLPModel", **network),
        algorithm=dict(
            class_name="PPO",
            num_learning_epochs=4,
            num_mini_batches=4,
            learning_rate=1e-3,
            schedule="adaptive",
            desired_kl=0.01,
            entropy_coef=0.005,
            gamma=0.99,
            lam=0.95,
        ),
    )
    env = adapters.RslRlVecEnv(pointgoal(n_envs, device))
    runner = OnPolicyRunner(env, settings, log_dir=None, device=device)
    runner.learn(max(1, samples // (n_envs * n_steps)))
    policy = runner.get_inference_policy(device)

    def act(obs, starts):
        from tensordict import TensorDict

        actions = policy(TensorDict(dict(policy=obs, critic=obs), batch_size=len(obs)))
        return actions.clamp(-1, 1)

    return act


def train_skrl(samples, device, n_envs=64):
    """Ten lines around skrl's own wrapper of Gymnasium, and its models."""
    from skrl.agents.torch.ppo import PPO, PPO_CFG
    from skrl.envs.wrappers.torch import wrap_env
    from skrl.memories.torch import RandomMemory
    from skrl.models.torch import CategoricalMixin, DeterministicMixin, Model
    from skrl.trainers.torch import SequentialTrainer
    from skrl.utils import set_seed

    def model(mixin, n_out):
        """Returns a class of models, as skrl makes them from a base and a mixin."""

        class Network(mixin, Model):
            def __init__(self, env):
                spaces = dict(
                    observation_space=env.observation_space, action_space=env.action_space
                )
                Model.__init__(self, **spaces, device=device)
                mixin.__init__(self)
                hidden = nn.Linear(8, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh()
                self.network = nn.Sequential(*hidden, nn.Linear(64, n_out))

            def compute(self, inputs, role):
                return self.network(inputs["observations"]), {}

        return Network

    Policy, Value = model(CategoricalMixin, 3), model(DeterministicMixin, 1)
    set_seed(1)
    vector = adapters.VectorEnv(pong(n_envs, device), "same_step")
    env = wrap_env(vector, wrapper="gymnasium")
    models = dict(policy=Policy(env).to(device), value=Value(env).to(device))
    memory = RandomMemory(memory_size=64, num_envs=n_envs, device=device)
    settings = PPO_CFG(
        rollouts=64, learning_epochs=4, mini_batches=4, learning_rate=1e-3, entropy_loss_scale=0.01
    )
    settings.experiment.write_interval = settings.experiment.checkpoint_interval = 0
    agent = PPO(
        models=models,
        memory=memory,
        cfg=settings,
        observation_space=env.observation_space,
        action_space=env.action_space,
        device=device,
    )
    trainer = SequentialTrainer(
        env=env,
        agents=agent,
        cfg=dict(timesteps=samples // n_envs, headless=True, disable_progressbar=True),
    )
    trainer.train()
    network = models["policy"].network
    return lambda obs, starts: torch.distributions.Categorical(logits=network(obs)).sample()


TRAINERS = {name: globals()[f"train_{name}"] for name in BUDGETS}


def compare(name, samples, device="cpu"):
    """Returns the (mean, half interval) of random actions and of a trained agent."""
    make, metric = (pointgoal, "success") if name == "rsl_rl" else (pong, "points_won")
    space = make(1, device).action_space
    generator = torch.Generator(device).manual_seed(1)

    def at_random(obs, starts):
        drawn = spaces.random_actions(space, len(obs), device, generator)
        return drawn[:, 0]

    act = TRAINERS[name](samples, device)
    return tuple(score(make(N_EPISODES, device), policy, metric) for policy in (at_random, act))


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("libraries", nargs="+", choices=TRAINERS)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--scale", type=float, default=1.0, help="of the budget of samples")
    options = parser.parse_args()
    for name in options.libraries:
        samples, start = int(BUDGETS[name] * options.scale), time.monotonic()
        random, trained = compare(name, samples, options.device)
        numbers = " · ".join(
            f"{who} {mean:.3f} ± {half:.3f}"
            for who, (mean, half) in (("random", random), ("trained", trained))
        )
        print(f"{name}: {samples:,} samples · {numbers} · {time.monotonic() - start:.0f} s")


if __name__ == "__main__":
    main()
