"""Runs ONNX's own node conformance tests through the compiler and the core's executor.

The cases come from the `onnx` package. Each is written as one model with its data among the initializers; `runtime/compiler`'s test
`onnx_node_cases` compiles and runs them all. Skipped where the package is missing.
"""

import os
import re
import subprocess
import types
import warnings

import pytest

np = pytest.importorskip("numpy")
onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402
from programs import ROOT, SELECTION  # noqa: E402

# The Makefile's: with another one cargo would build tract once more.
# The newest operator set that the compiler reads.
OPSET = 28


# With a scale that gives no whole length, these reckon with the length before it is rounded down; PyTorch and ONNX Runtime with the one after.
OTHERWISE = {"test_resize_downsample_scales_linear_align_corners"}


def write(case, folder):
    """Writes a case; False for element types, or numbers of values, that no policy has."""
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
    """Makes a case of a GRU of three steps whose expected outputs are ONNX Runtime's: the package has no case of the variant that PyTorch
    exports."""
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


def drawn(number):
    """Makes a case of a convolution, pool or change of size of random shape, whose expected output is ONNX Runtime's."""
    ort = pytest.importorskip("onnxruntime")
    random = np.random.default_rng(number)
    whole = lambda low, high, count=None: random.integers(low, high + 1, count).tolist()
    operator = ("Conv", "Conv", "MaxPool", "AveragePool", "Resize")[number % 5]
    rank = whole(1, 2)
    sides = whole(5, 12, rank)
    kernel, strides, dilations = whole(1, 4, rank), whole(1, 3, rank), whole(1, 2, rank)
    pads = [whole(0, size - 1) for size in kernel * 2]
    groups = whole(1, 3)
    channels = groups * whole(1, 9)
    # Eighths: sums of their products are exact, so that no order of them can differ near zero.
    eighths = lambda low, shape: (random.integers(low, 9, shape) / 8).astype(np.float32)
    inputs = {"X": eighths(-8 if operator == "Conv" else 1, [whole(1, 2), channels, *sides])}
    constants, attributes = {}, {"kernel_shape": kernel, "strides": strides, "pads": pads, "dilations": dilations}
    if operator == "Conv":
        # As many groups as channels in every third case.
        groups = channels if number % 3 == 0 else groups
        outputs = groups * whole(1, 2 if groups == channels else 20)
        constants["W"] = eighths(-8, [outputs, channels // groups, *kernel])
        constants |= {"B": eighths(-8, [outputs])} if number % 2 else {}
        attributes["group"] = groups
    elif operator == "Resize":
        mode = ("nearest", "linear")[whole(0, 1)]
        constants |= {"roi": np.zeros(0, np.float32), "scales": np.zeros(0, np.float32)}
        if whole(0, 1):
            constants["sizes"] = np.array([*inputs["X"].shape[:2], *whole(1, 20, rank)], np.int64)
        else:  # quarters: places are exact, so that no rounding chooses a neighbour
            constants["scales"] = np.array([1, 1, *(random.integers(2, 13, rank) / 4)], np.float32)
        ways = ("half_pixel", "asymmetric", "align_corners", "pytorch_half_pixel")
        attributes = {"mode": mode, "coordinate_transformation_mode": ways[whole(0, 3)], "nearest_mode": ("floor", "ceil", "round_prefer_floor", "round_prefer_ceil")[whole(0, 3)]}
    elif operator == "AveragePool":
        attributes |= {"count_include_pad": whole(0, 1), "ceil_mode": whole(0, 1)}
    else:
        attributes["ceil_mode"] = whole(0, 1)
    node = helper.make_node(operator, ["X", *constants], ["Y"], **attributes)
    tensors = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    declared = helper.make_tensor_value_info("X", TensorProto.FLOAT, inputs["X"].shape)
    graph = helper.make_graph([node], operator, [declared], [helper.make_tensor_value_info("Y", TensorProto.FLOAT, None)], tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 19)], ir_version=9)
    try:
        outputs = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"]).run(None, inputs)
    except Exception:  # the window is larger than the image, or ONNX Runtime has no kernel for it
        return None
    return types.SimpleNamespace(name=f"drawn_{operator.lower()}_{number}", model=model, data_sets=[(list(inputs.values()), outputs)])


def test_node_cases(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from onnx.backend.test.case.node import collect_testcases

        cases = collect_testcases(None)
    written = sum(write(case, tmp_path) for case in cases if case.name not in OTHERWISE)
    assert written > 300
    for case in map(gru, (0, 1)):
        assert write(case, tmp_path)
        written += 1
    images = [case for case in map(drawn, range(400)) if case]
    assert len(images) > 300
    written += sum(write(case, tmp_path) for case in images)
    command = ["cargo", "test", *SELECTION, "--lib", "onnx_node_cases", "--", "--ignored", "--nocapture"]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {"LADS_ONNX_NODES": str(tmp_path)}, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    agreed, refused = map(int, re.search(r"(\d+) cases agree, (\d+) are refused", done.stdout).groups())
    print(re.search(r".* cases agree.*", done.stdout).group())
    assert agreed + refused == written
    assert agreed > 700
