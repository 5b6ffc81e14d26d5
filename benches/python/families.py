"""Measures the control steps of policies of any family beside ONNX Runtime on the same schedule: one thread, hot, in turns.

    cargo build --release -p lads-benches --bin steps
    python benches/python/families.py target/release/steps BUNDLE.onnx...

In each round both run the golden episode from its beginning. ONNX Runtime's time is that of its calls alone, one for each entry that the schedule
runs, as the exporter's twin makes them: what Python does between them is not counted, copies of keys and values at their edges are. Of every step of
the episode the median of the rounds is taken; printed are their mean and the largest, the ratios of both, and the largest part of a control period.
Times are those in which the thread ran, so that a busy machine changes them little.
"""

import base64
import subprocess
import sys
import time

import numpy as np
import onnx
from lads_exporter import contract as contracts, twin
from safetensors.numpy import load

ROUNDS = 20


class Peer:
    """The policy in ONNX Runtime, and how long its calls of a control step took."""

    def __init__(self, model):
        self.twin, self.took = twin.Twin(model, twin.Zero() if contracts.of_role(contracts.of(model), "noise") else None), 0.0
        golden = load(base64.b64decode(contracts.properties(model)[contracts.GOLDEN_KEY]))
        self.instruction = int(golden["instruction"][0]) if "instruction" in golden else None
        self.channels = {name.removeprefix("channel."): rows for name, rows in golden.items() if name.startswith("channel.")}
        self.steps = len(next(iter(self.channels.values())))
        for entry in self.twin.entries.values():
            entry.session = self.timed(entry.session)

    def timed(self, session):
        peer = self

        class Timed:
            def run(self, outputs, inputs):
                begun = time.thread_time_ns()
                results = session.run(outputs, inputs)
                peer.took += time.thread_time_ns() - begun
                return results

        return Timed()

    def episode(self):
        """Runs the golden episode -> nanoseconds of each control step."""
        if self.instruction is not None:
            self.twin.set_instruction(self.instruction)
        self.twin.reset()
        found = []
        for step in range(self.steps):
            self.took = 0
            self.twin.step({name: rows[step] for name, rows in self.channels.items()})
            found.append(self.took)
        return np.array(found, float)


def main(worker, *paths):
    print("policy; us a step: mean, largest; as parts of ONNX Runtime's; largest of the control period")
    for path in paths:
        model = onnx.load(path)
        peer, period = Peer(model), contracts.of(model)["control_period_s"]
        process = subprocess.Popen([worker, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        names = []
        while name := process.stdout.readline().strip():
            names.append(name)
        if not names:
            return process.wait()

        def ask(name):
            process.stdin.write(f"{name} {peer.steps}\n")
            process.stdin.flush()
            return np.array(process.stdout.readline().split(), float)

        contenders = {"ONNX Runtime": peer.episode} | {name: lambda name=name: ask(name) for name in names}
        rounds = {name: [] for name in contenders}
        for number in range(ROUNDS):
            for name in list(contenders)[:: 1 if number % 2 == 0 else -1]:
                contenders[name]()  # its data are in the cache again
                rounds[name].append(contenders[name]())
        process.stdin.close()
        process.wait()
        steps = {name: np.median(found, 0) / 1e3 for name, found in rounds.items()}
        mean, most = steps["ONNX Runtime"].mean(), steps["ONNX Runtime"].max()
        print(f"{contracts.of(model)['family']['kind']} ({path}), {peer.steps} steps")
        for name, found in steps.items():
            print(f"  {name:14} {found.mean():9.1f} {found.max():9.1f}   {found.mean() / mean:5.2f}x {found.max() / most:5.2f}x   {100 * found.max() / 1e6 / period:6.2f} %")
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
