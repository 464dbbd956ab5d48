#!/usr/bin/env bash
# PyTorch 2.13.0: the log-probability of an action that a squashed Gaussian has drawn can be NaN. From a Gaussian
# value of about 9 on, tanh is 1 in float32, and its inverse infinite; the log-probability of an action read
# from a buffer is then inf - inf. While `cache_size=1` remembers the very tensor, it is finite: the same
# action is fine when it is drawn, and NaN in the update.
# Seen: 9.5 gives NaN as a copy, a number as the cached tensor; 8 gives a number either way.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q torch==2.13.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import torch
from torch.distributions import Normal, TanhTransform, TransformedDistribution

policy = TransformedDistribution(
    Normal(torch.tensor(0.0), torch.tensor(5.0)), TanhTransform(cache_size=1)
)


def logprobs(value):
    """Of the action for a Gaussian value, when it is drawn, and when it is read again."""
    action = policy.transforms[0](torch.tensor(value))
    drawn = policy.log_prob(action).item()
    return drawn, policy.log_prob(action.clone()).item()


large, small = logprobs(9.5), logprobs(8.0)
print("9.5, drawn and read:", large, "8:", small)
assert abs(large[0]) < 100 and large[1] != large[1]
assert abs(small[0] - small[1]) < 0.1
END
