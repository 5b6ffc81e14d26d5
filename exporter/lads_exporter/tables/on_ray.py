"""The engine of a Ray cluster: one task for each training, each export, and each instruction of an evaluation, on one CPU each.

A node gets the files of its command with it, and its files come back with their hashes, are checked, and are written into the job's folder here,
so that the folder looks as if the job had run here. A task whose node is lost begins anew on another one; a command that fails is not tried
again. A node where it cannot run at all (no program, no MuJoCo, no language encoder, another version) fails the job that it got, which is named
with the node, and gets no other. `stop` may be called by a signal's handler: trainings end in their checkpoints, which come back too.
"""

import hashlib
import json
import logging
import os
import re
import socket
import sys
import threading
import time

import numpy as np

from .. import dataset
from ..config import UserError
from ..output import write_atomically
from . import node, shards
from .commands import INTERRUPTED, Stopped

try:
    import ray
except ImportError as error:
    raise UserError("--engine ray needs Ray, which is not installed: pip install -e 'exporter[cluster]'") from error

LOST = 5  # times that a task may lose its node
CHECK = 0.5  # seconds between two looks at whether the table was stopped
PATIENCE = 10  # seconds to wait for somebody at the cluster's address, and between two looks at which nodes there are


class OnRay:
    def __init__(self, place, at_once=None):
        self.place, self.stopped, self.lock = place, False, threading.Lock()
        self.unfit = {}  # id of a node -> why nothing runs there
        self.expected, self.large = {}, {}
        _connect()
        self.alive, self.looked = _alive(), 0.0
        self.at_once = at_once or max(1, int(ray.cluster_resources().get("CPU", 1)))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        ray.shutdown()

    def run(self, command):
        for _, outcome in self._outcomes([command]):
            # The file that says that a step is done comes last.
            for path in command.writes:
                if path in outcome.files:
                    write_atomically(path, checked(path, outcome))
            self._judge(command, outcome)

    def evaluate(self, rollouts):
        """Runs each instruction by itself; the results appear whole or not at all."""
        paths = [rollouts.results.with_suffix(f".{number}.json") for number in range(len(rollouts.instructions))]
        commands = [rollouts.command(path, id) for path, id in zip(paths, rollouts.instructions, strict=True)]
        parts = {}
        for command, outcome in self._outcomes(commands):
            self._judge(command, outcome)
            [path] = command.writes
            parts[path] = json.loads(checked(path, outcome))
        merged = shards.merge([parts[path] for path in paths], rollouts.instructions)
        write_atomically(rollouts.results, json.dumps(merged).encode())

    def stop(self):
        # The threads that wait for tasks see it; calls of Ray have no place in a signal's handler.
        self.stopped = True

    def _outcomes(self, commands):
        """Runs commands side by side -> (command, its outcome), in the order in which they finish; where one fails, the others are called off."""
        if self.stopped:
            raise Stopped
        left, called_off = dict(zip(self._tasks(commands), commands)), False
        try:
            while left:
                done, _ = ray.wait(list(left), timeout=CHECK)
                self._tell_lost()
                if self.stopped and not called_off:
                    called_off = True
                    _call_off(left)
                for task in done:
                    yield left.pop(task), self._outcome(task)
        finally:
            if not called_off:
                _call_off(left)

    def _tell_lost(self):
        with self.lock:
            if time.monotonic() < self.looked + PATIENCE:
                return
            self.looked, now = time.monotonic(), _alive()
            for id in self.alive.keys() - now.keys():
                print(f"node {self.alive[id]} ({id[:8]}) is lost; what ran there begins anew", file=sys.stderr, flush=True)
            self.alive = now

    def _tasks(self, commands):
        sent = {}
        options = {"num_cpus": 1, "max_retries": LOST, "label_selector": self._fit_nodes()}
        work = ray.remote(node.work).options(**options)
        for command in commands:
            large = [self._sent(path) for path in self.place.large if path in command.reads]
            files = tuple(path for path in command.reads if path not in self.place.large)
            if files not in sent:
                sent[files] = ray.put({path: path.read_bytes() for path in files})
            yield work.remote(command, sent[files], self._expected(command.encoder), str(self.place.lads_run), large)

    def _sent(self, path):
        with self.lock:
            if path not in self.large:
                content = ray.put(np.fromfile(path, np.uint8))
                self.large[path] = node.Large(path, dataset.sha256(path), [content])
            return self.large[path]

    def _expected(self, encoder):
        with self.lock:
            if encoder not in self.expected:
                self.expected[encoder] = node.surroundings(self.place.lads_run, encoder)
            return self.expected[encoder]

    def _fit_nodes(self):
        """Selects the nodes on which nothing is known to be missing."""
        if not self.unfit:
            return {}
        if not _alive().keys() - self.unfit.keys():
            raise UserError("no node is left that can run it: " + "; ".join(self.unfit.values()))
        return {"ray.io/node-id": f"!in({','.join(self.unfit)})"}

    def _outcome(self, task):
        try:
            return ray.get(task)
        except ray.exceptions.TaskCancelledError as error:
            raise Stopped from error
        except ray.exceptions.RayTaskError as error:
            # It did not come as far as to name its node; Ray knows the address.
            address = re.search(r"ip=([\w.:]+)", str(error))
            problem = f"node at {address[1] if address else 'an unknown address'}: {_line(error)}; it needs the project, installed, in the version that runs the table"
            self.unfit |= {row["NodeID"]: problem for row in ray.nodes() if address and row["NodeManagerAddress"] == address[1]}
            raise UserError(problem) from error
        except ray.exceptions.RayError as error:
            raise UserError(f"Ray: {_line(error)}") from error

    def _judge(self, command, outcome):
        with open(command.log, "a") as log:
            log.write(f"on {outcome.node}:\n{outcome.output or outcome.problem}\n")
        if outcome.problem:
            self.unfit[outcome.id] = f"{outcome.node}: {outcome.problem}"
            raise UserError(self.unfit[outcome.id])
        if self.stopped or outcome.code == INTERRUPTED:
            raise Stopped
        if outcome.code:
            raise command.failed(outcome.code, outcome.output, f"{outcome.node}: ")


def _connect():
    address = os.environ.get("RAY_ADDRESS") or "local"
    own = {"include_dashboard": False} if address == "local" else {}
    # Ray tells its makers about a cluster that it starts, unless it is told not to.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        _knock(address)
        ray.init(address=address, log_to_driver=False, logging_level=logging.WARNING, **own)
    except (ray.exceptions.RayError, OSError, RuntimeError, ValueError) as error:
        raise UserError(f"no Ray at RAY_ADDRESS={address}: {_line(error)}; start one with: ray start --head") from error


def _knock(address):
    """Looks whether anybody listens at host:port, for which Ray itself takes minutes."""
    host, _, port = address.rpartition(":")
    if host and port.isdigit() and "/" not in host:
        socket.create_connection((host, int(port)), PATIENCE).close()


def _alive():
    """Lists the cluster's nodes -> {id: host}."""
    return {row["NodeID"]: row["NodeManagerHostname"] for row in ray.nodes() if row["Alive"]}


def _call_off(tasks):
    for task in tasks:
        ray.cancel(task)


def checked(path, outcome):
    """Returns a file that a node has sent, if it came as it was sent."""
    if path not in outcome.files:
        raise UserError(f"{outcome.node}: {path} was not written")
    sha256, content = outcome.files[path]
    if hashlib.sha256(content).hexdigest() != sha256:
        raise UserError(f"{outcome.node}: {path} came damaged; nothing was written")
    return content


def _line(error):
    return (str(error).strip().splitlines() or [type(error).__name__])[-1]
