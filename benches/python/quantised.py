"""A lads policy beside ONNX Runtime with the same bits: what each decides, how far its actions are off, and how long a step takes.

    python benches/python/quantised.py MODEL [REFERENCE] [--rounds N]

The contenders are the package `lads`, with the image that it makes of the bundle by itself, ONNX Runtime with the bundle's floats, and ONNX Runtime
with what its own tool, `quantize_dynamic` at its defaults, makes of each entry: integers of 8 bits for the weights, and for the inputs anew in every
step. In one more the low level keeps its floats. Where OpenVINO is installed (`pip install openvino nncf`) it is asked too, with the bundle's floats and
with what its own tool, NNCF's `compress_weights` to INT8_SYM, makes of it. All run in this process, one thread, called from Python.

First every contender is asked the reference's questions, open loop: how many decisions select PyTorch's index, and how far an action is off while the
same plan is in force. Bytes are those of lads' image, and of the weights of ONNX Runtime's sessions. Then the time: in each round every contender steps through the same recorded episode, hot and then at 50 Hz, in the next round
in the opposite order. A ratio is taken between two medians of the same round; printed is the median of these, with quartiles.
What can fail ends with Python's exception.
"""

import argparse
import base64
import json
import logging
import tempfile
import time
from pathlib import Path

import lads
import numpy as np
import onnx
import onnxruntime
from onnx.utils import Extractor
from onnxruntime.quantization import quantize_dynamic

try:
    import nncf
    import openvino
except ImportError:
    openvino = None

HIGH = ("high_level/instruct", "high_level/start", "high_level/step")
LOW = ("codebook/lookup", "low_level/act")
PERIOD = 0.02


class Lads:
    def __init__(self, path):
        self.policy = lads.open(path)
        self.controller = self.policy.controller(instruction=self.policy.contract.instructions[0].id)
        self.action = np.zeros(self.policy.contract.action.shape, np.float32)

    def start(self, instruction):
        self.controller.instruct(instruction)

    def step(self, observation):
        """-> action, index of the plan in force."""
        _, report = self.controller.step(observation, self.action)
        return self.action, report.selected.index

    def executed(self, action):
        self.controller.executed(action)


class Graphs:
    """A bundle's entries, each a graph of its own that an engine runs; keys and values stay in the engine's own tensors from step to step."""

    def __init__(self, model, quantised=()):
        contract = json.loads(next(entry.value for entry in model.metadata_props if entry.key == "lads.contract"))
        self.horizon = contract["family"]["horizon"]
        self.known = [row["id"] for row in contract["instructions"]]
        limits = next(row for row in contract["channels"] if row["role"] == "action")["elements"]
        self.low, self.high = (np.array([row[side] for row in limits], np.float32) for side in ("min", "max"))
        self.graphs, weights = {}, {}
        for entry in HIGH + LOW:
            names = lambda values, entry=entry: [value.name for value in values if value.name.startswith(entry + "/")]
            part = Extractor(model).extract_model(names(model.graph.input), names(model.graph.output))
            self.graphs[entry], own = self.load(part, entry in quantised)
            weights |= own
        self.size = sum(weights.values())
        arrays = {row.name: row for row in model.graph.initializer}
        self.words = onnx.numpy_helper.to_array(arrays["weights/instruction.words"])
        self.lengths = onnx.numpy_helper.to_array(arrays["constants/instruction.lengths"])

    def run(self, entry, inputs):
        """Inputs by their names without the entry's -> outputs likewise."""
        found = self.infer(self.graphs[entry], {f"{entry}/{name}": value for name, value in inputs.items()})
        return {name.removeprefix(entry + "/"): value for name, value in found.items()}

    def start(self, instruction):
        number = self.known.index(instruction)
        found = self.run("high_level/instruct", {"words": self.words[number][None].copy()})
        rows = int(self.lengths[number])
        self.cache = {name.replace("present", "past_key_values"): self.array(it)[:, :, :rows].copy() for name, it in found.items()}
        self.time, self.done, self.plan, self.index = 0, None, None, None

    def step(self, observation):
        inputs = {"observation": observation[None], "timestep": np.array([self.time])} | self.cache
        if self.done is not None:
            inputs["action"] = self.done[None]
        found = self.run("high_level/start" if self.done is None else "high_level/step", inputs)
        logits = found.pop("logits")
        self.cache = {name.replace("present", "past_key_values"): it for name, it in found.items()}
        if self.time % self.horizon == 0:
            self.index = int(self.array(logits).argmax())
            self.plan = self.run("codebook/lookup", {"index": np.array([self.index])})["plan"]
        action = self.run("low_level/act", {"observation": observation[None], "plan": self.plan})["action"]
        self.done = np.clip(self.array(action)[0], self.low, self.high)
        self.time += 1
        return self.done, self.index

    def executed(self, action):
        self.done = action


class OnnxRuntime(Graphs):
    array = staticmethod(onnxruntime.OrtValue.numpy)

    def load(self, part, quantised):
        """-> the graph, ready to run, and the bytes of its weights by their names."""
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 3
        part = integers(part) if quantised else part
        session = onnxruntime.InferenceSession(part.SerializeToString(), options, providers=["CPUExecutionProvider"])
        weights = {tensor.name: len(tensor.raw_data) for tensor in part.graph.initializer}
        return (session, [value.name for value in session.get_outputs()]), weights

    def infer(self, graph, inputs):
        session, outputs = graph
        value = lambda it: it if isinstance(it, onnxruntime.OrtValue) else onnxruntime.OrtValue.ortvalue_from_numpy(it)
        found = session.run_with_ort_values(outputs, {name: value(it) for name, it in inputs.items()})
        return dict(zip(outputs, found, strict=True))


class OpenVino(Graphs):
    array = staticmethod(np.asarray)

    def load(self, part, quantised):
        """-> the graph, ready to run, and the bytes of its weights by their names."""
        core = openvino.Core()
        graph = core.read_model(part.SerializeToString())
        if quantised:
            nncf.set_log_level(logging.ERROR)
            graph = nncf.compress_weights(graph, mode=nncf.CompressWeightsMode.INT8_SYM)
        weights = {row.get_friendly_name(): row.get_byte_size() for row in graph.get_ops() if row.get_type_name() == "Constant"}
        options = {"INFERENCE_NUM_THREADS": 1, "NUM_STREAMS": 1, "PERFORMANCE_HINT": "LATENCY", "INFERENCE_PRECISION_HINT": "f32"}
        request = core.compile_model(graph, "CPU", options).create_infer_request()
        return (request, [output.get_any_name() for output in graph.outputs]), weights

    def infer(self, graph, inputs):
        # Keys and values are copied from one step to the next, as by its own API for Python.
        request, outputs = graph
        found = request.infer(inputs, share_inputs=True)
        return {name: found[name] for name in outputs}


def integers(model):
    """What ONNX Runtime's own tool makes of a graph."""
    with tempfile.TemporaryDirectory() as folder:
        before, after = (Path(folder) / name for name in ("floats.onnx", "integers.onnx"))
        onnx.save(model, before)
        # It does not know the type of every value in between by itself.
        quantize_dynamic(before, after, extra_options={"DefaultTensorType": onnx.TensorProto.FLOAT})
        return onnx.load(after)


def episodes(reference, widths):
    """-> (id, observations, actions, plans, control steps that decide) of each traced episode."""
    numbers = lambda text, width: np.frombuffer(base64.b64decode(text), "<f4").reshape(-1, width)
    for instruction in reference["instructions"]:
        for episode in instruction["episodes"]:
            if trace := episode.get("trace"):
                seen, done = (numbers(trace[key], width) for key, width in zip(("observations", "actions"), widths, strict=True))
                decided = episode.get("decided_at", range(0, len(seen), reference["horizon"]))
                yield instruction["id"], seen, done, episode["plans"], list(decided)


def answers(contender, asked):
    """-> share of decisions with PyTorch's index, how many there are, largest difference of an action while the plan in force is PyTorch's."""
    same = decisions = 0
    largest = 0.0
    for known, seen, done, plans, decided in asked:
        contender.start(known)
        number = -1
        for step, (observation, executed) in enumerate(zip(seen, done, strict=True)):
            action, index = contender.step(observation)
            if number + 1 < len(decided) and decided[number + 1] == step:
                number += 1
                decisions += 1
                same += index == plans[number]
            if index == plans[number]:
                largest = max(largest, float(np.abs(action - executed).max()))
            contender.executed(executed)
    return same / decisions, decisions, largest


def timed(contender, known, seen, decided, period):
    """-> median of the ordinary steps and of the decisions, in us."""
    contender.start(known)
    took = {False: [], True: []}
    due = time.perf_counter()
    for step, observation in enumerate(seen):
        if period:
            due += period
            time.sleep(max(due - time.perf_counter(), 0))
        start = time.perf_counter()
        contender.step(observation)
        if step > 0:  # the first one has no action behind it
            took[step in decided].append(1e6 * (time.perf_counter() - start))
    return np.median(took[False]), np.median(took[True])


def main():
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("model", type=Path)
    arguments.add_argument("reference", type=Path, nargs="?")
    arguments.add_argument("--rounds", type=int, default=20)
    arguments.add_argument("--steps", type=int, default=100, help="control steps of an episode in a round")
    asked = arguments.parse_args()
    model = onnx.load(asked.model)
    mine = Lads(asked.model)
    contenders = {
        "lads": mine,
        "ONNX Runtime f32": OnnxRuntime(model),
        "ONNX Runtime int8": OnnxRuntime(model, HIGH + LOW),
        "ONNX Runtime int8, low level f32": OnnxRuntime(model, HIGH),
    }
    if openvino:
        contenders |= {
            "OpenVINO f32": OpenVino(model),
            "OpenVINO int8 weights": OpenVino(model, HIGH + LOW),
            "OpenVINO int8 weights, low level f32": OpenVino(model, HIGH),
        }
    size = {name: len(it.policy.image) if it is mine else it.size for name, it in contenders.items()}
    reference = json.loads((asked.reference or asked.model.with_suffix(".reference.json")).read_text())
    contract = mine.policy.contract
    widths = [int(np.prod(channel.shape)) for channel in (contract.observations[0], contract.action)]
    traces = list(episodes(reference, widths))
    found = {name: answers(it, traces) for name, it in contenders.items()}
    known, seen, _, _, decided = max(traces, key=lambda trace: len(trace[1]))
    seen, paces = seen[: asked.steps], {"hot": 0.0, "at 50 Hz": PERIOD}
    rounds = {(pace, name): [] for pace in paces for name in contenders}
    for number in range(asked.rounds):
        for pace, period in paces.items():
            for name in list(contenders)[:: 1 if number % 2 == 0 else -1]:
                rounds[pace, name].append(timed(contenders[name], known, seen, decided, period))
    other = f"OpenVINO {openvino.__version__} with NNCF {nncf.__version__}" if openvino else "OpenVINO is not installed: pip install openvino nncf"
    print(f"ONNX Runtime {onnxruntime.__version__}, {other}; {asked.rounds} rounds of {len(seen)} steps; ratio: lads over the other, median (quartiles)")
    columns = [f"{pace}: {kind}" for pace in paces for kind in ("ordinary, us", "ratio", "decision, us")]
    print("| | bytes | same index | largest action difference | " + " | ".join(columns) + " |")
    print("|" + "---|" * (4 + len(columns)))
    for name in contenders:
        share, decisions, largest = found[name]
        cells = [f"{size[name]:,}", f"{100 * share:.1f} % of {decisions}", f"{largest:.1e}"]
        for pace in paces:
            ours, theirs = np.array(rounds[pace, "lads"]), np.array(rounds[pace, name])
            low, middle, high = np.percentile(ours[:, 0] / theirs[:, 0], [25, 50, 75])
            ordinary, decision = np.median(theirs, 0)
            cells += [f"{ordinary:.0f}", f"{middle:.2f} ({low:.2f} to {high:.2f})", f"{decision:.0f}"]
        print(f"| {name} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
