#!/usr/bin/env bash
# PyTorch 2.13.0, CPU: one seed begins other networks on hosts with other numbers of cores. `nn.init.orthogonal_` draws
# the same numbers everywhere, but the QR decomposition after it, by MKL, rounds as its threads share the work; by
# default there is one per core. So it is on a GPU, too, where weights are initialised before they are moved.
# `torch.set_num_threads(1)` around the initialisation helps. (Known of sums and products; the page of `orthogonal_` and
# that of `set_num_threads` say nothing.)
# Seen: weights of 128 x 256 with 2 and 4 threads are not those with 1 thread, by up to 3e-7; those of 1 x 128 and
# 7 x 128 are equal, and so is `randn` of all three shapes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q torch==2.13.0 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import torch


def begin(init, rows, columns, threads):
    torch.set_num_threads(threads)
    torch.manual_seed(0)
    return init(torch.empty(rows, columns))


for rows, columns in ((1, 128), (7, 128), (128, 256)):
    for init in (torch.Tensor.normal_, torch.nn.init.orthogonal_):
        one, two, four = (begin(init, rows, columns, threads) for threads in (1, 2, 4))
        print(init.__name__, rows, columns, "off by", (two - one).abs().max().item(), (four - one).abs().max().item())
        is_same = init is torch.Tensor.normal_ or rows < 128
        assert one.equal(two) == one.equal(four) == is_same
        assert init is torch.Tensor.normal_ or torch.allclose(two @ two.T, torch.eye(rows), atol=1e-5)
END
