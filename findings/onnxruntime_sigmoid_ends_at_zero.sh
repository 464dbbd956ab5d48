#!/usr/bin/env bash
# ONNX Runtime 1.32.0, CPU: a sigmoid is exactly 0 below about -17, and far from exact before. float32 holds such
# chances down to 1e-38, and PyTorch and the runtime's own Softplus do. The log-probability of a rare action, of
# Bernoulli policies and discriminators, is -inf in an exported network where it was -20 in training.
# Seen: of -20 it is 0, where exp(-20) is 2e-9; of -16 it is off by a tenth or more; exp(-Softplus(20)) is right.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q onnxruntime==1.32.0 onnx==1.23.2 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import math

import numpy as np
import onnxruntime
from onnx import TensorProto, helper


def run(kind, values):
    x, y = (helper.make_tensor_value_info(name, TensorProto.FLOAT, [len(values)]) for name in "xy")
    graph = helper.make_graph([helper.make_node(kind, ["x"], ["y"])], kind, [x], [y])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    session = onnxruntime.InferenceSession(model.SerializeToString())
    return session.run(None, {"x": np.array(values, np.float32)})[0].tolist()


values = [-8, -12, -16, -20, -50]
exact = [1 / (1 + math.exp(-x)) for x in values]
sigmoids = run("Sigmoid", values)
by_softplus = [math.exp(-y) for y in run("Softplus", [-x for x in values])]
print("exact:", exact, "sigmoids:", sigmoids, "by softplus:", by_softplus)
assert sigmoids[3:] == [0, 0] and abs(sigmoids[2] / exact[2] - 1) > 0.05
assert np.allclose(by_softplus, exact, rtol=1e-4, atol=0)
END
