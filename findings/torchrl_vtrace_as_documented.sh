#!/usr/bin/env bash
# TorchRL 0.14.1: who calls `vtrace_advantage_estimate` by its documentation gets importance ratios upside down.
# `log_pi` is said to be of the actor that collected, `log_mu` of the current one; the function needs them the other
# way. Actions that the policy gave up then count in full, those that it came to prefer hardly at all.
# Seen, a reward of 1 for an action whose chance fell from 0.5 to 0.1: a target of 1 as documented, else of 0.2.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q torchrl==0.14.1 torch==2.13.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import inspect

import torch
from torchrl.objectives.value.functional import vtrace_advantage_estimate

text = inspect.getdoc(vtrace_advantage_estimate)
assert "log_pi (Tensor): collection actor" in text and "log_mu (Tensor): current actor" in text
collected, current = (torch.full((1, 1, 1), chance).log() for chance in (0.5, 0.1))
value, reward, end = torch.zeros(1, 1, 1), torch.ones(1, 1, 1), torch.ones(1, 1, 1, dtype=torch.bool)


def target(log_pi, log_mu):
    _, targets = vtrace_advantage_estimate(0.9, log_pi, log_mu, value, value, reward, end, end)
    return round(targets.item(), 3)


as_documented, reversed_ = target(log_pi=collected, log_mu=current), target(log_pi=current, log_mu=collected)
print("targets as documented and the other way:", as_documented, reversed_)
assert (as_documented, reversed_) == (1, 0.2)
END
