"""Measures control steps of policies that see images beside ONNX Runtime on the same graph: one thread, hot, in turns.

    cargo build --release -p lads-benches --bin steps
    python benches/python/images.py target/release/steps BUNDLE.onnx... [FORMAT...]

Formats are those of weights, such as int16, beside 32-bit floats. In each round every contender gets a block of steps, and a ratio is taken between two medians of the same round; printed are the medians
of all blocks' medians and of the ratios, with quartiles. Times are those in which the thread ran, so that a busy machine changes them
little. The library's own step includes the checks of the frame.
"""

import subprocess
import sys
import time

import numpy as np
import onnxruntime

ROUNDS, SECONDS = 40, 0.25


def session(path):
    """Returns a function that runs one step, on frames of the shapes that the graph states."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    found = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(0)
    feed = {}
    for info in found.get_inputs():
        feed[info.name] = rng.integers(0, 256, info.shape, np.uint8) if "uint8" in info.type else rng.uniform(-1, 1, info.shape).astype(np.float32)
    return lambda: found.run(None, feed)


def main(worker, *arguments):
    formats = [argument for argument in arguments if not argument.endswith(".onnx")]
    for path in (argument for argument in arguments if argument.endswith(".onnx")):
        process = subprocess.Popen([worker, path, *formats], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        names = []
        while name := process.stdout.readline().strip():
            names.append(name)
        if not names:
            return process.wait()
        run = session(path)

        def ask(name, count):
            process.stdin.write(f"{name} {count}\n")
            process.stdin.flush()
            return np.array(process.stdout.readline().split(), float) / 1e6

        def peer(count):
            took = []
            for _ in range(count):
                start = time.thread_time()
                run()
                took.append(1e3 * (time.thread_time() - start))
            return np.array(took)

        contenders = {"ONNX Runtime": peer} | {name: lambda count, name=name: ask(name, count) for name in names}
        counts = {name: max(3, int(SECONDS * 1e3 / np.median(contender(5)))) for name, contender in contenders.items()}
        medians = {name: [] for name in contenders}
        least = dict.fromkeys(contenders, np.inf)
        for number in range(ROUNDS):
            for name in list(contenders)[:: 1 if number % 2 == 0 else -1]:
                contenders[name](2)
                took = contenders[name](counts[name])
                medians[name].append(np.median(took))
                least[name] = min(least[name], took.min())
        process.stdin.close()
        process.wait()
        ratios = {name: np.array(medians[name]) / medians["ONNX Runtime"] for name in contenders}
        print(path)
        for name in contenders:
            low, middle, high = np.percentile(ratios[name], [25, 50, 75])
            print(f"  {name:14}  {np.median(medians[name]):8.3f} ms, least {least[name]:8.3f} ms, {middle:.2f}x ({low:.2f} to {high:.2f}), of the least {least[name] / least['ONNX Runtime']:.2f}x")


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
