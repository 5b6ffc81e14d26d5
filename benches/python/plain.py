"""Makes policies of the shapes that robots' policy files have, with random weights, as bundles: of one entry, from an observation to an action.

    python benches/python/plain.py FOLDER

writes mlp.onnx (a legged robot's, 51-512-256-128-14), gru.onnx (41 observed values, a GRU of 256, 16 joints) and history.onnx (fifteen rows of 47
observed values as one vector, 705-512-256-128-12); Elu between the layers.
"""

import sys
from pathlib import Path

import onnx
import torch
from lads_exporter import bundle, contract as contracts, graphs, random_policy
from lads_exporter.kinds import plain
from torch import nn

ENTRY = plain.ENTRY
LEGGED = (51, 512, 256, 128, 14)


def environment(observed, acted):
    """Describes a robot of so many observed values and joints, at 50 Hz."""
    names = lambda kind, count: [{"name": f"{kind}{i}", "unit": "1", "min": -10.0, "max": 10.0} for i in range(count)]
    return {
        "id": "legged-bench",
        "version": "1",
        "control_period_s": 0.02,
        "quaternion_order": "none",
        "reference": "default position",
        "observation": names("observation", observed),
        "action": [{**row, "joint": row["name"], "interface": "position"} for row in names("action", acted)],
    }


def sealed(graph, observed, acted, states=None):
    """Seals a graph as a bundle with a golden episode."""
    world = environment(observed, acted)
    contract = bundle.describe({"kind": "plain"}, world, [], None, {"setting": "bench", "seed": 0}, channels=contracts.channels(world), states=states)
    candidates = ((None, random_policy.channels(contract, 20, n)) for n in range(1, 50))
    return bundle.seal(graph.model("plain"), contract, candidates)


def layer(entry, x, module, name):
    return entry.gemm(x, entry.weight(f"{name}.weight", module.weight), entry.weight(f"{name}.bias", module.bias), name)


def mlp(*widths):
    """Makes a policy of dense layers."""
    torch.manual_seed(0)
    graph = graphs.Graph()
    entry = graphs.Entry(graph, ENTRY)
    x = entry.input("observation", [1, widths[0]])
    for place, (inputs, outputs) in enumerate(zip(widths, widths[1:])):
        last = place == len(widths) - 2
        x = layer(entry, x, nn.Linear(inputs, outputs), "action" if last else f"layer{place}")
        x = x if last else entry.op("Elu", [x], f"layer{place}.elu")
    entry.output("action", [1, widths[-1]])
    return sealed(graph, widths[0], widths[-1])


def gru(observed, hidden, acted):
    """Makes a policy of a GRU and a dense layer."""
    torch.manual_seed(0)
    graph = graphs.Graph()
    entry = graphs.Entry(graph, ENTRY)
    x = plain.gru(entry, entry.input("observation", [1, observed]), nn.GRU(observed, hidden))
    layer(entry, x, nn.Linear(hidden, acted), "action")
    entry.output("action", [1, acted])
    return sealed(graph, observed, acted, [plain.state("gru_h", hidden)])


def main(folder):
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name, model in {"mlp": mlp(*LEGGED), "gru": gru(41, 256, 16), "history": mlp(705, 512, 256, 128, 12)}.items():
        onnx.save(model, folder / f"{name}.onnx")


if __name__ == "__main__":
    main(*sys.argv[1:])
