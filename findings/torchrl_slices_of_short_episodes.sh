#!/usr/bin/env bash
# TorchRL 0.14.1: `SliceSampler` draws an episode first, each as likely as any other, then a slice of it. A step of an
# episode of 10 steps is learnt from nine times as often as one of an episode of 90: early deaths, and easy starts,
# outweigh what long episodes are about, more than in the data.
# Seen: of an episode of 90 steps and one of 10, half of the drawn steps are of the first, not nine tenths.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q torchrl==0.14.1 torch==2.13.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer

torch.manual_seed(0)
sampler = SliceSampler(slice_len=2, traj_key="episode")
memory = TensorDictReplayBuffer(storage=LazyTensorStorage(100), sampler=sampler, batch_size=20_000)
memory.extend(TensorDict({"episode": torch.tensor([0] * 90 + [1] * 10)}, [100]))
share = (memory.sample()["episode"] == 0).float().mean().item()
print("share of the long episode:", share, "of 0.9")
assert 0.47 < share < 0.53
END
