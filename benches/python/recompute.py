"""Exports the high level as a plain export does: the logits from the whole history at once, without a KV cache.

    python recompute.py BUNDLE EPISODE.json OUTPUT.onnx

EPISODE holds the instruction and the observations and actions to measure on. They become the inputs' shapes, and beside the model
lies OUTPUT.json with the inputs by name and the logits that PyTorch computed.
"""

import json
import sys
import warnings

import torch
from worker import load

from eager import Eager


class Whole(torch.nn.Module):
    def __init__(self, net):
        super().__init__()
        self.net = net

    def forward(self, words, observations, actions):
        return self.net.recompute(words, observations, actions)


def main(bundle, episode, output):
    warnings.simplefilter("ignore")  # the exporter warns that it is being replaced
    with open(episode, encoding="utf-8") as file:
        episode = json.load(file)
    net = Eager(*load(bundle))
    with torch.no_grad():
        inputs = {"words": net.words(episode["instruction"])}
        inputs |= {name: torch.tensor(episode[name]) for name in ("observations", "actions")}
        whole = Whole(net).eval()
        logits = whole(**inputs)
        names = {"input_names": list(inputs), "output_names": ["logits"], "opset_version": 17}
        torch.onnx.export(whole, tuple(inputs.values()), output, dynamo=False, **names)
    beside = {name: tensor.tolist() for name, tensor in (inputs | {"logits": logits}).items()}
    with open(output.removesuffix(".onnx") + ".json", "w", encoding="utf-8") as file:
        json.dump(beside, file)


if __name__ == "__main__":
    main(*sys.argv[1:])
