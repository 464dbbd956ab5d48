#!/usr/bin/env bash
# Stable-Baselines3 2.9.2: training with the usual schedule `lambda left: 3e-4 * left` ends with a negative learning
# rate, that is, by climbing the loss. Rollouts are collected whole, so that more steps are taken than were asked for,
# and `left`, which "goes from 1 to 0", is below 0 then. `LinearSchedule` of the package stops at its end.
# Seen, 2,048 steps a rollout, 3,000 asked for: the rate of the second and last update is -0.00011.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q stable-baselines3==2.9.2 torch==2.13.0
"$folder/bin/python" -W ignore - <<'END'
import stable_baselines3


class Recorded(stable_baselines3.PPO):
    def train(self):
        super().train()
        rates.append(round(self.policy.optimizer.param_groups[0]["lr"], 6))


rates = []
agent = Recorded("MlpPolicy", "CartPole-v1", n_steps=2048, learning_rate=lambda left: 3e-4 * left, device="cpu")
agent.learn(3000)
print("learning rates:", rates)
assert rates == [0.000095, -0.00011]
END
