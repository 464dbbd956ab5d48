#!/usr/bin/env bash
# skrl 2.1.1: with PPO's default `time_limit_bootstrap=False` advantages run through a time limit into the
# next episode of the lane, as if its rewards had been earned before. `time_limit_bootstrap=True` ends them.
# Seen: the advantage of a step before a truncation changes by gamma * lambda * 100 when the reward of the
# next episode's first step is raised by 100.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q skrl==2.1.1 torch==2.13.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import torch
from skrl.agents.torch.ppo.ppo import compute_gae


def advantage_before_the_limit(reward_after, **options):
    def column(*values):
        return torch.tensor(values).reshape(-1, 1, 1)

    rewards, values = column(1.0, reward_after, 1.0), torch.zeros(3, 1, 1)
    terminated, truncated = column(False, False, False), column(True, False, False)
    settings = dict(discount_factor=0.5, lambda_coefficient=1.0, **options)
    result = compute_gae(
        rewards=rewards,
        terminated=terminated,
        truncated=truncated,
        values=values,
        last_values=torch.zeros(1, 1),
        **settings,
    )
    # compute_gae normalises advantages and returns them beside the returns
    returns = result[0] if isinstance(result, tuple) else result
    return float(returns.flatten()[0])


default = advantage_before_the_limit(101.0) - advantage_before_the_limit(1.0)
ended = [advantage_before_the_limit(r, time_limit_bootstrap=True) for r in (1.0, 101.0)]
print("change:", default, "with time_limit_bootstrap:", ended)
assert default == 50 and ended[0] == ended[1]
END
