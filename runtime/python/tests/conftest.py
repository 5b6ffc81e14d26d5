"""Policies for the tests: the shipped ones, and small random ones of other families, made once by the exporter."""

import faulthandler
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import lads

faulthandler.enable()

PROJECT = Path(__file__).parents[3]
# Also for the other processes that tests start: they inherit the path.
sys.path.insert(0, str(PROJECT / "exporter"))
KINDS = ("plain", "recurrent", "stacked", "camera", "skilldiffuser")


@pytest.fixture(scope="session")
def bundles(tmp_path_factory):
    """Paths of random policies by kind; each kind is made when it is first asked for."""
    folder = tmp_path_factory.mktemp("bundles")

    class Made(dict):
        def __missing__(self, kind):
            path = folder / f"{kind}.onnx"
            environment = {**os.environ, "PYTHONPATH": str(PROJECT / "exporter")}
            subprocess.run([sys.executable, "-m", "lads_exporter", "random", "--kind", kind, "-o", path], check=True, env=environment, capture_output=True)
            self[kind] = path
            return path

    return Made()


@pytest.fixture(scope="session")
def language_cache(tmp_path_factory):
    """A folder for LADS_CACHE with the language encoder of the shipped policies, exported once."""
    graph, language = pytest.importorskip("lads_exporter.language_graph"), pytest.importorskip("lads_exporter.language")
    folder = tmp_path_factory.mktemp("cache")
    assert graph.write(language.DEFAULT, folder / "language" / language.DEFAULT)
    return folder


@pytest.fixture(scope="session")
def kitchen():
    """The small kitchen policy: instructions, plans, a KV cache."""
    return lads.open(PROJECT / "models/kitchen-small.onnx")


@pytest.fixture(scope="session")
def plain(bundles):
    """A memoryless policy without instructions."""
    return lads.open(bundles["plain"])


@pytest.fixture
def seen(plain):
    """An observation of `plain`, float32 [8]."""
    return plain.golden.observations["observation"][0].copy()


def replay(controller, golden):
    """Returns the actions for a golden episode's observations and noise."""
    actions = []
    for step in range(len(golden.actions)):
        given = {name: values[step] for name, values in golden.observations.items()}
        if golden.noise.shape[1]:
            given["noise"] = golden.noise[step]
        actions.append(controller.step(given)[0])
    return np.stack(actions)


def busy(call, threads):
    """Returns the refusals of `call` while other threads are in it, and the number of calls that were not refused."""
    stop, calls, refused = threading.Event(), [], []

    def work():
        while not stop.is_set():
            try:
                call()
                calls.append(1)
            except lads.errors.BusyError as error:
                refused.append(str(error))

    all_ = [threading.Thread(target=work) for _ in range(threads)]
    for thread in all_:
        thread.start()
    deadline = time.monotonic() + 60
    while not refused and time.monotonic() < deadline:
        time.sleep(0.01)
    stop.set()
    for thread in all_:
        thread.join()
    assert refused, "in a minute no two threads met"
    return refused[0], len(calls)
