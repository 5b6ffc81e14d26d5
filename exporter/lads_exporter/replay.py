"""Runs a bundle with ONNX Runtime, entry by entry, the way the controller does.

This is the exporter's reference for golden episodes and tests; the product's control loop is the Rust core.
"""

import numpy as np
import onnxruntime
from onnx.utils import Extractor

ENTRIES = (
    "instruction/lookup",
    "high_level/instruct",
    "high_level/start",
    "high_level/step",
    "codebook/lookup",
    "low_level/act",
    "trajectory_encoder/encode",
)


def extract(model, entry):
    """One entry of a bundle as a model of its own."""
    names = lambda values: [value.name for value in values if value.name.startswith(entry + "/")]
    return Extractor(model).extract_model(names(model.graph.input), names(model.graph.output))


class Bundle:
    """All entries of a bundle, each in its own ONNX Runtime session."""

    def __init__(self, model):
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.log_severity_level = 3
        self.sessions = {}
        for entry in ENTRIES:
            data = extract(model, entry).SerializeToString()
            self.sessions[entry] = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])

    def run(self, entry, inputs):
        """inputs and result: local name -> array."""
        session = self.sessions[entry]
        outputs = [value.name for value in session.get_outputs()]
        results = session.run(outputs, {f"{entry}/{name}": value for name, value in inputs.items()})
        return {name.removeprefix(entry + "/"): value for name, value in zip(outputs, results)}

    def instruct(self, instruction):
        """Instruction index -> the context: past keys and values of its words."""
        known = self.run("instruction/lookup", {"id": np.array([instruction])})
        length = int(known["length"][0])
        present = self.run("high_level/instruct", {"words": known["words"]})
        return {name.replace("present", "past_key_values"): rows[:, :, :length] for name, rows in present.items()}

    def advance(self, context, action, observation, timestep):
        """Appends (a_{t-1}, s_t), or s_0 when `action` is None -> logits [M], the grown context."""
        inputs = {"observation": observation[None], "timestep": np.array([timestep])} | context
        if action is not None:
            inputs["action"] = action[None]
        out = self.run("high_level/start" if action is None else "high_level/step", inputs)
        logits = out.pop("logits")[0]
        return logits, {name.replace("present", "past_key_values"): rows for name, rows in out.items()}

    def open_loop(self, contract, instruction, observations):
        """Replays recorded observations [T, O] -> plans [T], actions [T, A] (clipped), logits [T, M].

        The policy's own clipped actions enter its history. Episodes beyond the context are refused.
        """
        assert len(observations) <= contract["context"]["steps"]
        low, high = (np.array([row[key] for row in contract["action"]], np.float32) for key in ("min", "max"))
        words = self.instruct(instruction)
        plans, actions, all_logits = [], [], []
        context, action = words, None
        for t, observation in enumerate(observations):
            logits, context = self.advance(context, action, observation, t)
            if t % contract["horizon"] == 0:
                index = int(logits.argmax())
                plan = self.run("codebook/lookup", {"index": np.array([index])})["plan"]
            raw = self.run("low_level/act", {"observation": observation[None], "plan": plan})["action"][0]
            action = np.clip(raw, low, high)
            plans.append(index)
            actions.append(action)
            all_logits.append(logits)
        return np.array(plans), np.stack(actions), np.stack(all_logits)
