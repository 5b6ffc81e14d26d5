"""Makes stand.onnx and walk.onnx, two policies with random weights in the form in which rsl_rl exports one: [1, 51] -> [1, 14].

    python runtime/host/examples/biped/make.py

Invariant: the same files, byte for byte, whenever it runs.
"""

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

SIZES = (51, 64, 32, 14)


def policy(seed):
    """Dense layers with Elu between them."""
    rng = np.random.default_rng(seed)
    nodes, weights, value = [], [], "obs"
    for layer, (given, made) in enumerate(zip(SIZES, SIZES[1:])):
        matrix = rng.standard_normal((made, given)) / np.sqrt(given)
        bias = 0.1 * rng.standard_normal(made)
        names = f"actor.{2 * layer}.weight", f"actor.{2 * layer}.bias"
        weights += [numpy_helper.from_array(array.astype(np.float32), name) for array, name in zip((matrix, bias), names)]
        last = layer == len(SIZES) - 2
        output = "actions" if last else f"dense_{layer}"
        nodes.append(helper.make_node("Gemm", [value, *names], [output], transB=1))
        value = output
        if not last:
            nodes.append(helper.make_node("Elu", [value], [f"elu_{layer}"]))
            value = f"elu_{layer}"
    edge = lambda name, width: helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, width])
    graph = helper.make_graph(nodes, "actor", [edge("obs", SIZES[0])], [edge("actions", SIZES[-1])], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 11)], ir_version=6, producer_name="pytorch")
    onnx.checker.check_model(model)
    return model.SerializeToString()


if __name__ == "__main__":
    for seed, name in enumerate(("stand", "walk")):
        Path(__file__).with_name(f"{name}.onnx").write_bytes(policy(seed))
