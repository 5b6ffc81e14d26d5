"""PyTorch and OpenVINO as contenders: both run one control step of a policy, as the other peers do."""

import numpy as np
import onnx
from onnx.utils import Extractor


def policies():
    return {"PyTorch": Torch, "OpenVINO": OpenVino}


def limits(contract):
    """Returns the action's lowest and highest values."""
    action = next(row for row in contract["channels"] if row["role"] == "action")
    return tuple([element[key] for element in action["elements"]] for key in ("min", "max"))


class Torch:
    def __init__(self, model, contract, instruction):
        import torch

        from eager import Eager

        self.torch, self.instruction = torch, instruction
        self.inference = torch.inference_mode()
        self.inference.__enter__()
        self.net = Eager(model, contract)
        self.low, self.high = (torch.tensor(side) for side in limits(contract))
        self.detail = f"{torch.__version__}, eager, inference mode, 1 thread, keys and values written in place"

    def tensor(self, row):
        return self.torch.tensor(row, dtype=self.torch.float32)

    def instruct(self):
        self.net.instruct(self.net.words(self.instruction))

    def at(self, tokens):
        """Returns to a context of `tokens` tokens."""
        self.net.past = tokens

    def tokens(self):
        return self.net.past

    def step(self, observation, action, time, plan, decides):
        """Runs a control step -> action, plan, its index or None."""
        logits = self.net.step(observation, action, time)
        index = None
        if decides:
            index = int(logits.argmax())
            plan = self.net.plan(index)
        return self.act(observation, plan), plan, index

    def act(self, observation, plan):
        return self.torch.clamp(self.net.act(observation, plan), self.low, self.high)

    def numbers(self, action):
        return action.tolist()

    def recompute(self, observations, actions):
        words = self.net.words(self.instruction)
        observations, actions = (self.tensor(rows) for rows in (observations, actions))
        return lambda: self.net.recompute(words, observations, actions)


class OpenVino:
    """OpenVINO as a contender: keys and values are handed from call to call as tensors; the runtime allocates its outputs where a context
    is new to it."""

    def __init__(self, model, contract, instruction):
        import openvino

        core = openvino.Core()
        settings = {
            "INFERENCE_NUM_THREADS": 1,
            "NUM_STREAMS": 1,
            "PERFORMANCE_HINT": "LATENCY",
            "INFERENCE_PRECISION_HINT": "f32",
            "KV_CACHE_PRECISION": "f32",
        }
        self.openvino, self.requests, self.names = openvino, {}, {}
        for entry in ("high_level/instruct", "high_level/start", "high_level/step", "codebook/lookup", "low_level/act"):
            names = lambda values: [v.name for v in values if v.name.startswith(entry + "/")]
            inputs, outputs = names(model.graph.input), names(model.graph.output)
            part = Extractor(model).extract_model(inputs, outputs).SerializeToString()
            self.requests[entry] = core.compile_model(core.read_model(part), "CPU", settings).create_infer_request()
            self.names[entry] = outputs
        arrays = {t.name: onnx.numpy_helper.to_array(t) for t in model.graph.initializer}
        self.length = int(arrays["constants/instruction.lengths"][instruction])
        self.known = arrays["weights/instruction.words"][instruction][None].copy()
        self.low, self.high = (np.array(side, np.float32) for side in limits(contract))
        self.cache, self.saved = {}, {}
        self.detail = f"{openvino.__version__.split('-')[0]}, Python, f32, 1 thread, latency hint"

    def tensor(self, row):
        return np.array(row, np.float32)

    def run(self, entry, inputs):
        request = self.requests[entry]
        for name, array in inputs.items():
            request.set_tensor(f"{entry}/{name}", self.openvino.Tensor(array, shared_memory=True))
        request.infer()
        return request

    def instruct(self):
        request = self.run("high_level/instruct", {"words": self.known})
        self.cache = self.present("high_level/instruct", request, self.length)

    def present(self, entry, request, rows=None):
        read = lambda name: request.get_tensor(name).data[:, :, :rows].copy()
        short = lambda name: name.removeprefix(entry + "/").replace("present", "past_key_values")
        return {short(name): read(name) for name in self.names[entry] if "/present." in name}

    def tokens(self):
        tokens = next(iter(self.cache.values())).shape[2]
        self.saved[tokens] = self.cache
        return tokens

    def at(self, tokens):
        self.cache, self.frozen = self.saved[tokens], True

    frozen = False

    def step(self, observation, action, time, plan, decides):
        entry = "high_level/start" if action is None else "high_level/step"
        inputs = {"observation": observation[None], "timestep": np.array([time])} | self.cache
        if action is not None:
            inputs["action"] = action[None]
        request = self.run(entry, inputs)
        index = None
        if decides:
            index = int(request.get_tensor(entry + "/logits").data.argmax())
            lookup = self.run("codebook/lookup", {"index": np.array([index])})
            plan = lookup.get_tensor("codebook/lookup/plan").data[0].copy()
        # A repeated step keeps the context that it has: copying the grown one would be work that bound outputs save.
        if not self.frozen:
            self.cache = self.present(entry, request)
        return self.act(observation, plan), plan, index

    def act(self, observation, plan):
        request = self.run("low_level/act", {"observation": observation[None], "plan": plan[None]})
        return np.clip(request.get_tensor("low_level/act/action").data[0], self.low, self.high)

    def numbers(self, action):
        return [float(x) for x in action]
