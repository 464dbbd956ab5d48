#!/usr/bin/env bash
# onnxruntime 1.32.0: sessions of one file in one process draw the same random numbers, in the same order, unless its
# nodes name a seed. Policies that sample in the graph, one session per robot or per thread, take the same "random"
# actions in all of them. In the next process they are others; `onnxruntime.set_seed` before each session helps.
# Seen: two sessions have equal noise, step by step, and other noise after set_seed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q onnxruntime==1.32.0 onnx==1.23.2 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import onnx
import onnxruntime
from onnx import TensorProto, helper

node = helper.make_node("RandomNormal", [], ["noise"], shape=[3])
noise = helper.make_tensor_value_info("noise", TensorProto.FLOAT, [3])
graph = helper.make_graph([node], "policy", [], [noise])
model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)


def draws():
    session = onnxruntime.InferenceSession(model.SerializeToString())
    return [session.run(None, {})[0].tolist() for _ in range(3)]


one, other = draws(), draws()
onnxruntime.set_seed(1)
seeded = draws()
print("two sessions:", one[0], other[0], "after set_seed:", seeded[0])
assert one == other and one[0] != one[1] and seeded != one
END
