#!/usr/bin/env bash
# onnxruntime 1.32.0: ArgMax and ReduceMax take NaN as it comes, by its place. NumPy and PyTorch let NaN
# win (the exported graph was traced with them), so a policy with a NaN among its logits acts elsewhere
# after the export, and the maximum hides the NaN.
# Seen: ArgMax of (1, nan, 3) is 2, of (nan, 1, 3) is 0; NumPy says 1 and 0. ReduceMax of the first is 3.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q onnxruntime==1.32.0 onnx==1.23.2 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import numpy as np
import onnxruntime
from onnx import TensorProto, helper


def run(operation, values):
    kind = TensorProto.INT64 if operation == "ArgMax" else TensorProto.FLOAT
    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, [3])
    y = helper.make_tensor_value_info("y", kind, None)
    node = helper.make_node(operation, ["x"], ["y"], keepdims=0)
    model = helper.make_model(
        helper.make_graph([node], "g", [x], [y]), opset_imports=[helper.make_opsetid("", 18)]
    )
    model.ir_version = 9
    session = onnxruntime.InferenceSession(
        model.SerializeToString(), providers=["CPUExecutionProvider"]
    )
    return session.run(None, {"x": np.array(values, np.float32)})[0]


nan = float("nan")
middle, first = run("ArgMax", [1, nan, 3]), run("ArgMax", [nan, 1, 3])
largest = run("ReduceMax", [1, nan, 3])
print("ArgMax:", middle, first, "ReduceMax:", largest)
assert (middle, first, largest) == (2, 0, 3)
assert (np.argmax([1, nan, 3]), np.argmax([nan, 1, 3])) == (1, 0)
END
