"""PPO in one file, in the style of CleanRL, on tensors of a Gymnasium vector environment.

    pip install 'megastep-flatland[gymnasium]'
    python scripts/examples/ppo_gymnasium.py --env megastep/Pong-v0 --samples 2_000_000

Nothing but Gymnasium and PyTorch is used: `gymnasium.make_vec` makes the environment, whose
observations, rewards and flags stay on its device. In NEXT_STEP the action that begins an episode
has no effect, so that transition is left out of the losses.
"""

import argparse

import megastep.adapters  # noqa: F401  # isort: skip  (before torch; registers environments)

import gymnasium
import torch
from torch import nn


def layer(n_in, n_out, gain=2**0.5):
    linear = nn.Linear(n_in, n_out)
    nn.init.orthogonal_(linear.weight, gain)
    nn.init.zeros_(linear.bias)
    return linear


class Agent(nn.Module):
    def __init__(self, n_obs, n_actions, width=64):
        super().__init__()
        self.actor = nn.Sequential(
            *(layer(n_obs, width), nn.Tanh(), layer(width, width), nn.Tanh()),
            layer(width, n_actions, 0.01),
        )
        self.critic = nn.Sequential(
            *(layer(n_obs, width), nn.Tanh(), layer(width, width), nn.Tanh()), layer(width, 1, 1.0)
        )

    def policy(self, obs):
        return torch.distributions.Categorical(logits=self.actor(obs))

    def value(self, obs):
        return self.critic(obs)[:, 0]


def flat(obs):
    """Observations, a tensor or a dict of them, as (B, D) float32."""
    leaves = obs.values() if isinstance(obs, dict) else [obs]
    return torch.cat([leaf.flatten(1).float() for leaf in leaves], 1)


def train(
    env="megastep/Pong-v0",
    samples=2_000_000,
    num_envs=256,
    n_steps=32,
    device="cpu",
    seed=1,
    lr=1e-3,
    gamma=0.99,
    gae_lambda=0.95,
    clip=0.2,
    entropy_coef=0.01,
    n_epochs=4,
    n_minibatches=4,
):
    """Returns the trained agent."""
    torch.manual_seed(seed)
    envs = gymnasium.make_vec(env, num_envs, to_numpy=False, device=device)
    obs = flat(envs.reset(seed=seed)[0])
    agent = Agent(obs.shape[1], envs.single_action_space.n).to(device)
    optimizer = torch.optim.Adam(agent.parameters(), lr, eps=1e-5)
    n_updates = max(1, samples // (num_envs * n_steps))
    ended = torch.zeros(num_envs, dtype=torch.bool, device=device)
    returns, running = torch.zeros((), device=device), torch.zeros(num_envs, device=device)
    n_episodes = torch.zeros((), device=device)

    for update in range(n_updates):
        optimizer.param_groups[0]["lr"] = lr * (1 - update / n_updates)
        steps = []
        for _ in range(n_steps):
            with torch.no_grad():
                policy = agent.policy(obs)
                action = policy.sample()
            next_obs, reward, terminated, truncated, _ = envs.step(action)
            steps.append(
                (obs, action, policy.log_prob(action), reward, terminated, truncated, ~ended)
            )
            running = (running + reward).masked_fill(ended, 0)
            obs, ended = flat(next_obs), terminated | truncated
            returns, n_episodes = returns + running[ended].sum(), n_episodes + ended.sum()
        all_obs, actions, old_logs, rewards, terminals, truncations, valid = map(
            torch.stack, zip(*steps)
        )

        with torch.no_grad():
            values = agent.value(torch.cat([all_obs.flatten(0, 1), obs])).view(n_steps + 1, -1)
            advantages, advantage = torch.zeros_like(rewards), torch.zeros_like(rewards[0])
            for t in reversed(range(n_steps)):
                # the observation after a truncated step is the true last one
                target = rewards[t] + gamma * values[t + 1] * ~terminals[t]
                carried = gamma * gae_lambda * advantage * ~(terminals[t] | truncations[t])
                advantage = (target - values[t] + carried) * valid[t]
                advantages[t] = advantage
        targets = (advantages + values[:-1])[valid]
        batch = [x[valid] for x in (all_obs, actions, old_logs, advantages)]
        for _ in range(n_epochs):
            for index in torch.randperm(len(targets), device=device).chunk(n_minibatches):
                b_obs, b_actions, b_logs, b_advantages = (x[index] for x in batch)
                policy = agent.policy(b_obs)
                ratio = (policy.log_prob(b_actions) - b_logs).exp()
                scaled = (b_advantages - b_advantages.mean()) / (b_advantages.std() + 1e-8)
                gain = torch.min(ratio * scaled, ratio.clamp(1 - clip, 1 + clip) * scaled).mean()
                value_loss = 0.5 * (agent.value(b_obs) - targets[index]).square().mean()
                loss = 0.5 * value_loss - gain - entropy_coef * policy.entropy().mean()
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
                optimizer.step()
        if (update + 1) % 32 == 0 or update + 1 == n_updates:
            mean = returns / n_episodes.clamp(min=1)
            print(f"{(update + 1) * n_steps * num_envs:,} samples  return {mean:.3f}", flush=True)
            returns, n_episodes = torch.zeros_like(returns), torch.zeros_like(n_episodes)
    envs.close()
    return agent


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    for name, default in zip(train.__code__.co_varnames, train.__defaults__):
        parser.add_argument(f"--{name}", type=type(default), default=default)
    train(**vars(parser.parse_args()))
