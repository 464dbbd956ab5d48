#!/usr/bin/env bash
# PyTorch 2.13.0: True in a mask of booleans forbids attention in `nn.MultiheadAttention`, and allows it in
# `scaled_dot_product_attention`. With the mask of the one the other runs, and agents attend to just those that
# they must not see. One that sees nobody gets NaN from the first, but zeros with `need_weights=False`.
# Seen, identity weights, each sees itself alone: outputs are equal with opposite masks, 2 apart with the same one.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q torch==2.13.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import torch
from torch.nn import functional

torch.manual_seed(0)
agents = torch.randn(1, 3, 4)
layer = torch.nn.MultiheadAttention(4, 1, bias=False, batch_first=True)
with torch.no_grad():
    layer.in_proj_weight.copy_(torch.eye(4).repeat(3, 1))
    layer.out_proj.weight.copy_(torch.eye(4))


@torch.no_grad()
def outputs(forbidden, **settings):
    own, _ = layer(agents, agents, agents, attn_mask=forbidden, **settings)
    same, opposite = (
        functional.scaled_dot_product_attention(agents, agents, agents, attn_mask=mask)
        for mask in (forbidden, ~forbidden)
    )
    return own, same, opposite


own, same, opposite = outputs(~torch.eye(3, dtype=torch.bool))
print("difference with the same mask:", (own - same).abs().max(), "with the opposite:", (own - opposite).abs().max())
assert torch.allclose(own, opposite) and (own - same).abs().max() > 2
nobody = torch.tensor([[True] * 3, [False] * 3, [False] * 3])
own, _, opposite = outputs(nobody)
quick, *_ = outputs(nobody, need_weights=False)
print("who sees nobody:", own[0, 0], quick[0, 0], opposite[0, 0])
assert own[0, 0].isnan().all() and (quick[0, 0] == 0).all() and (opposite[0, 0] == 0).all()
END
