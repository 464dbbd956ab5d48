#!/usr/bin/env bash
# d3rlpy 2.8.1: the last step of an episode that a time limit ends is never learnt from, as its dataset has no place
# for the observation after it. A reward that is paid at the limit, such as for all that was collected, is in no
# batch; the same step with a terminal is.
# Seen: of two episodes of four steps, with a reward of 10 at their ends, batches have the one of the terminal alone.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q d3rlpy==2.8.1 torch==2.13.0
"$folder/bin/python" -W ignore - <<'END'
import d3rlpy
import numpy as np

observations, rewards = np.arange(8, dtype=np.float32)[:, None], np.array([0, 0, 0, 10] * 2, np.float32)
data = d3rlpy.dataset.MDPDataset(
    observations=observations,
    actions=np.zeros((8, 1), np.float32),
    rewards=rewards,
    terminals=np.array([0, 0, 0, 1, 0, 0, 0, 0]),
    timeouts=np.array([0, 0, 0, 0, 0, 0, 0, 1]),
)
seen = set()
for _ in range(200):
    batch = data.sample_transition_batch(32)
    seen |= {*zip(batch.observations[:, 0].tolist(), batch.rewards[:, 0].tolist())}
print("steps that are drawn, with their rewards:", sorted(seen))
assert {step for step, _ in seen} == {0, 1, 2, 3, 4, 5, 6}
assert [step for step, reward in seen if reward] == [3]
END
