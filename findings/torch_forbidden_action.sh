#!/usr/bin/env bash
# PyTorch 2.13.0: a Categorical of probabilities gives an action of probability 0 a log-probability of -15.9, as
# it raises 0 to the smallest step of float32; one of logits with -inf gives -inf. The importance weight of a
# forbidden action is finite, and it depends on how actions were masked.
# Seen: -15.94 and -inf; where two policies forbid it both, their ratio is 1, or NaN.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q torch==2.13.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import math

import torch
from torch.distributions import Categorical

probs = torch.tensor([0.0, 0.5, 0.5])
by_probs = Categorical(probs=probs).log_prob(torch.tensor(0))
by_logits = Categorical(logits=probs.log()).log_prob(torch.tensor(0))
ratios = [(a - a).exp().item() for a in (by_probs, by_logits)]
print("log-probabilities:", by_probs.item(), by_logits.item(), "ratios:", ratios)
assert abs(by_probs.item() - math.log(torch.finfo(torch.float32).eps)) < 1e-4
assert by_logits == -math.inf and ratios[0] == 1 and math.isnan(ratios[1])
END
