"""Measures the Python package: a step beside Rust and ONNX Runtime, an import, batches over threads, the size of a wheel.

    make wheel && .venv/bin/python -m pip install target/wheels/lads-*.whl
    .venv/bin/python benches/python.py [--seconds 10] [--rust target/release/examples/step_cost]

Contenders are measured in turns, a share of some milliseconds at a time; the fastest share of each counts when hot, the median at a control
period. It asks for SCHED_FIFO, with which other programs take its memory bandwidth and caches but not its cores, and says whether it was
granted. Needs the exporter's environment (PyTorch, ONNX Runtime).
"""

import argparse
import gc
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import onnx

PROJECT = Path(__file__).parents[1]
sys.path[:0] = [str(PROJECT / "exporter"), str(PROJECT / "benches/python")]

import lads  # noqa: E402
import plain as bundles  # noqa: E402
from lads.vector import Controllers  # noqa: E402
from lads_exporter.twin import Entry  # noqa: E402

# Seconds of a share: shorter than what a busy system gives a process at a time, so that the fastest one was not interrupted.
SHARE = 0.002
# Seconds before its deadline at which a contender that warms up does so.
LEAD = 0.001


def hot(contenders, seconds):
    """Measures the contenders hot, in turns: microseconds of one call of each, the fastest share."""
    calls = {}
    for name, call in contenders.items():
        start = time.perf_counter()
        for _ in range(20):
            call()
        calls[name] = max(1, int(SHARE * 20 / (time.perf_counter() - start)))
    best = dict.fromkeys(contenders, float("inf"))
    deadline = time.perf_counter() + seconds
    while time.perf_counter() < deadline:
        for name, call in contenders.items():
            count = range(calls[name])
            start = time.perf_counter()
            for _ in count:
                call()
            best[name] = min(best[name], (time.perf_counter() - start) / calls[name] * 1e6)
    return best


def paced(contenders, seconds, warming=None, rate=50):
    """Measures the contenders at a control period, in turns call by call: microseconds of one call of each, median.

    What `warming` has for a contender is called shortly before its deadline and not measured.
    """
    found = {name: [] for name in contenders}
    deadline = time.perf_counter()
    until = lambda moment: time.sleep(max(0.0, moment - time.perf_counter()))
    for _ in range(int(seconds * rate)):
        for name, call in contenders.items():
            deadline += 1 / rate
            if warming:
                until(deadline - LEAD)
                warming[name]()
            until(deadline)
            start = time.perf_counter()
            call()
            found[name].append((time.perf_counter() - start) * 1e6)
    return {name: statistics.median(times) for name, times in found.items()}


def stepper(policy, controller=None):
    """Makes a call of `step` on the golden episode's first observation."""
    golden = policy.golden
    controller = controller or policy.controller(golden.instruction)
    (seen,) = (values[0].copy() for values in golden.observations.values())
    out = np.zeros(policy.contract.action.shape, np.float32)
    return lambda: controller.step(seen, out)


def beside_rust(program, path, policy, seconds):
    """Measures a step from Python and from Rust in microseconds, in turns, the fastest share of each."""
    call = stepper(policy)
    python = native = float("inf")
    deadline = time.perf_counter() + seconds
    while time.perf_counter() < deadline:
        python = min(python, hot({"python": call}, seconds / 20)["python"])
        share = str(max(1, int(SHARE / (python * 1e-6))))
        done = subprocess.run([program, path, share], check=True, capture_output=True, text=True)
        native = min(native, float(done.stdout) / 1000)
    return python, native


def scaling(policy, seconds, count=8):
    """Measures a step of 8 controllers on one thread and on two, in microseconds: hot, and at a control period."""
    golden = policy.golden
    (seen,) = (np.repeat(values[:1], count, 0) for values in golden.observations.values())
    out = np.zeros((count, *policy.contract.action.shape), np.float32)
    batches = {threads: Controllers(policy, count, golden.instruction, threads=threads) for threads in (1, 2)}
    calls = {threads: lambda batch=batch: batch.step(seen, out) for threads, batch in batches.items()}
    return hot(calls, seconds), paced(calls, seconds)


def alone():
    """Asks the system not to give this process's cores to ordinary ones -> what it granted."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(20))
    except (AttributeError, OSError):
        return "other programs get in between"
    return "SCHED_FIFO"


def processor():
    """Returns the processor's name, as far as the system says it."""
    told = Path("/proc/cpuinfo")
    names = [line.split(":")[1].strip() for line in told.read_text().splitlines() if line.startswith("model name")] if told.exists() else []
    return f"{os.cpu_count()} cores of {names[0] if names else platform.processor() or platform.machine()}"


def importing():
    """Measures the milliseconds that importing the package takes beyond numpy, the fastest of ten, without the interpreter's start."""
    code = "import numpy, time; start = time.perf_counter(); import lads; print((time.perf_counter() - start) * 1000)"
    return min(float(subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout) for _ in range(10))


def leak(policy, controllers):
    """Measures the growth of this process's memory in kB over so many controllers that each take a step."""
    golden = policy.golden
    (seen,) = (values[0].copy() for values in golden.observations.values())

    def make(count):
        for _ in range(count):
            policy.controller(golden.instruction).step(seen)
        gc.collect()
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4

    make(1000)
    before = make(1)
    start = time.perf_counter()
    grown = make(controllers) - before
    return grown, (time.perf_counter() - start) / controllers * 1e6


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=10.0, help="for each comparison")
    parser.add_argument("--controllers", type=int, default=100_000)
    parser.add_argument("--rust", type=Path, help="the example step_cost of lads-host, built in release")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path, model = Path(folder) / "legged.onnx", bundles.mlp(*bundles.LEGGED)
        onnx.save(model, path)
        legged = lads.open(path)
        session = Entry(model, bundles.ENTRY).session
        (seen,) = (values[0].copy() for values in legged.golden.observations.values())
        given = {f"{bundles.ENTRY}/observation": seen[None]}
        print(f"{processor()}, {alone()}, load {os.getloadavg()[0]:.1f}, {time.strftime('%Y-%m-%d')}, lads {lads.__version__}")
        print(f"policy {'-'.join(map(str, bundles.LEGGED))}, Elu")
        controller, run = legged.controller(), lambda: session.run(None, given)
        contenders = {"lads": stepper(legged, controller), "onnxruntime": run}
        # Each by its own means: what brings its code and weights into the caches.
        warming = {"lads": controller.warm, "onnxruntime": run}
        for name, found in (
            ("hot", hot(contenders, arguments.seconds)),
            ("at 50 Hz", paced(contenders, arguments.seconds)),
            ("at 50 Hz, warmed 1 ms before", paced(contenders, arguments.seconds, warming)),
        ):
            ratio = found["lads"] / found["onnxruntime"]
            print(f"  {name}: lads {found['lads']:.2f} us, onnxruntime {found['onnxruntime']:.2f} us, ratio {ratio:.2f}")
        kitchen = lads.open(PROJECT / "models/kitchen.onnx")
        if arguments.rust:
            for name, policy in ((str(path), legged), (str(PROJECT / "models/kitchen.onnx"), kitchen)):
                python, native = beside_rust(arguments.rust, name, policy, arguments.seconds)
                print(f"  step of {Path(name).stem}: from Python {python:.2f} us, from Rust {native:.2f} us, {python - native:+.2f} us")
        for name, found in zip(("hot", "at 50 Hz"), scaling(kitchen, arguments.seconds)):
            print(f"8 controllers of kitchen, {name}: one thread {found[1]:.0f} us, two {found[2]:.0f} us, {found[1] / found[2]:.2f} times faster")
        print(f"import: {importing():.1f} ms")
        grown, each = leak(legged, arguments.controllers)
        print(f"{arguments.controllers} controllers: {grown} kB more memory, {each:.0f} us each")
        for wheel in sorted((PROJECT / "target/wheels").glob("lads-*.whl")):
            print(f"wheel: {wheel.name}, {wheel.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
