"""ONNX's own node conformance tests through the compiler and the core's executor.

The cases come from the `onnx` package. Each is written as one model with its data among the initializers; `runtime/compiler`'s test
`onnx_node_cases` compiles and runs them all. Skipped where the package is missing.
"""

import os
import pathlib
import re
import subprocess
import types
import warnings

import pytest

np = pytest.importorskip("numpy")
onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

ROOT = pathlib.Path(__file__).resolve().parents[2]
# The Makefile's: with another one cargo would build tract once more.
SELECTION = ("--workspace", "--features", "lads-sim/report,lads-sim/record,lads-sim/viewer,lads-sim/language")
# The newest operator set that the compiler reads.
OPSET = 28


def write(case, folder):
    """Writes a case; False for element types, or numbers of values, that a policy has none of."""
    inputs, outputs = (list(values) for values in case.data_sets[0])
    if len(case.model.graph.node) == 1 and case.model.graph.node[0].op_type == "LayerNormalization":
        # Mean and deviation are optional outputs for training.
        outputs = outputs[:1]
    values = inputs + outputs
    if not all(isinstance(value, np.ndarray) and value.dtype in (np.float32, np.int64, np.int32, np.bool_) for value in values):
        return False
    model = onnx.ModelProto()
    model.CopyFrom(case.model)
    graph = model.graph
    if len(graph.node) == 1 and len(outputs) < len(graph.output):
        del graph.output[len(outputs) :], graph.node[0].output[len(outputs) :]
    if len(graph.input) != len(inputs) or len(graph.output) != len(outputs) or any(value.size == 0 for value in values):
        return False
    names, free = {}, {"in": list("abcde"), "out": list("yz"), "index": ["j"]}
    for info, value in zip(list(graph.input), inputs, strict=True):
        if value.dtype in (np.int64, np.int32):
            # Axes, shapes and indices are constants in every exported policy.
            names[info.name] = f"test/graph/{info.name}"
            graph.initializer.append(numpy_helper.from_array(value, names[info.name]))
            graph.input.remove(info)
        elif not free["in"]:
            return False
        else:
            short = free["in"].pop(0)
            names[info.name] = f"test/graph/{short}"
            graph.initializer.append(numpy_helper.from_array(value, f"given/{short}"))
    for info, value in zip(graph.output, outputs, strict=True):
        kind = free["index" if value.dtype in (np.int64, np.int32) else "out"]
        if not kind or info.name in names:
            return False
        short = kind.pop(0)
        names[info.name] = f"test/graph/{short}"
        graph.initializer.append(numpy_helper.from_array(value, f"expected/{short}"))
    for node in graph.node:
        node.input[:] = [names.get(name, name) for name in node.input]
        node.output[:] = [names.get(name, name) for name in node.output]
    for info in [*graph.input, *graph.output]:
        info.name = names[info.name]
    for opset in model.opset_import:
        if opset.domain in ("", "ai.onnx"):
            opset.version = min(opset.version, OPSET)
    (folder / f"{case.name}.onnx").write_bytes(model.SerializeToString())
    return True


def gru(linear_before_reset):
    """A GRU of three steps whose expected outputs are ONNX Runtime's: the package has no case of the variant that PyTorch exports."""
    ort = pytest.importorskip("onnxruntime")
    steps, batch, width, hidden = 3, 2, 4, 5
    shapes = {"X": [steps, batch, width], "W": [1, 3 * hidden, width], "R": [1, 3 * hidden, hidden], "B": [1, 6 * hidden]}
    random = np.random.default_rng(7 + linear_before_reset)
    inputs = {name: random.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    results = {"Y": [steps, 1, batch, hidden], "Y_h": [1, batch, hidden]}
    declared = [
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in part.items()] for part in (shapes, results)
    ]
    node = helper.make_node("GRU", list(shapes), list(results), hidden_size=hidden, linear_before_reset=linear_before_reset)
    graph = helper.make_graph([node], "gru", *declared)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    outputs = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"]).run(None, inputs)
    name = f"gru_linear_before_reset_{linear_before_reset}"
    return types.SimpleNamespace(name=name, model=model, data_sets=[(list(inputs.values()), outputs)])


def test_node_cases(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from onnx.backend.test.case.node import collect_testcases

        cases = collect_testcases(None)
    written = sum(write(case, tmp_path) for case in cases)
    assert written > 300
    for case in map(gru, (0, 1)):
        assert write(case, tmp_path)
        written += 1
    command = ["cargo", "test", *SELECTION, "--lib", "onnx_node_cases", "--", "--nocapture"]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {"LADS_ONNX_NODES": str(tmp_path)}, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    agreed, refused = map(int, re.search(r"(\d+) cases agree, (\d+) are refused", done.stdout).groups())
    print(re.search(r".* cases agree.*", done.stdout).group())
    assert agreed + refused == written
    assert agreed > 200
