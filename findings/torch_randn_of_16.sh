#!/usr/bin/env bash
# PyTorch 2.13.0, CPU: `torch.randn` draws its first 15 numbers otherwise when it is asked for 16 or more.
# With one seed, noise for 15 agents and for 16 agents has no number in common, and of 17 the last 16 are
# drawn anew: a policy that explores with `randn(n_agents)` is not the same agent in a larger team.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q torch==2.13.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import torch


def draw(n):
    torch.manual_seed(0)
    return torch.randn(n)


print(draw(15)[:3], draw(16)[:3], draw(17)[:3])
assert draw(8).equal(draw(15)[:8]) and draw(16).equal(draw(32)[:16])
assert not (draw(15) == draw(16)[:15]).any()
assert draw(17)[0] == draw(16)[0] and not (draw(17)[1:] == draw(16).new_tensor(draw(32)[1:17])).any()
END
