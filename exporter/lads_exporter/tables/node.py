"""Runs one command of a table on a node of a cluster: in a folder that is gone afterwards, from files that came with it, and gives back what it wrote.

A node has the project under the same path as where the table runs, with the same program and language encoder, which is checked by their hashes
before anything runs; else its numbers would stand under the hash of other inputs. Nothing here raises but what the engine has no word for: what is
wrong is told in the outcome.
"""

import ctypes
import hashlib
import importlib.metadata
import os
import signal
import socket
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from .. import dataset, language
from ..config import UserError
from .commands import ENVIRONMENT, INTERRUPTED

CHECK = 0.3  # seconds between two looks at a process; an interrupt is seen in between
PR_SET_PDEATHSIG = 1  # of Linux, linux/prctl.h


@dataclass(frozen=True)
class Outcome:
    node: str  # its name for people
    id: str  # Ray's
    code: int = 0  # exit code of the command
    problem: str = ""  # why the command was not run
    output: str = ""  # all that it printed
    files: dict = field(default_factory=dict)  # path -> (sha256, bytes), of those that it wrote or changed


@dataclass(frozen=True)
class Large:
    """A large file, a dataset or its frames, which is sent to nodes that do not have it."""

    path: Path
    sha256: str
    sent: list  # one reference to its bytes, in a list so that they come only where they are asked for


def surroundings(lads_run, encoder=None):
    """Describes what a command's numbers depend on besides its files -> {what: hash or version}; what is missing is an error."""
    found = {"the exporter's code": _code(), **{name: importlib.metadata.version(name) for name in ("numpy", "onnx", "torch")}}
    if not Path(lads_run).is_file():
        raise UserError(f"no program at {lads_run}; build it there: make setup && cargo build --release -p lads-sim")
    try:
        started = subprocess.run([str(lads_run), "--version"], capture_output=True, text=True, timeout=60)
    except OSError as error:
        raise UserError(f"{lads_run} does not start: {error}") from error
    if started.returncode:
        raise UserError(f"{lads_run} does not start ({started.returncode}): {(started.stderr.strip().splitlines() or ['no output'])[-1]}; run: make setup")
    found[str(lads_run)] = dataset.sha256(lads_run)
    if encoder and not encoder.startswith("random-"):
        found[f"the language encoder {encoder}"] = language.weights_sha256(encoder)
    return found


def _code():
    package = Path(__file__).resolve().parent.parent
    known = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        known.update(f"{path.relative_to(package)}\0".encode() + path.read_bytes() + b"\0")
    return known.hexdigest()


def work(command, inputs, expected, lads_run, large):
    """Runs a command. inputs: {path: bytes}; expected: its surroundings where the table runs; large: files for a training."""
    import ray

    id = ray.get_runtime_context().get_node_id()
    node = f"node {socket.gethostname()} ({id[:8]})"
    try:
        check(expected, surroundings(lads_run, command.encoder))
        with tempfile.TemporaryDirectory(prefix="lads-table-") as root:
            code, output, files = _run(command, inputs, large, Path(root))
            return Outcome(node, id, code, output=output, files=files)
    except (UserError, OSError) as error:
        return Outcome(node, id, problem=str(error))
    except KeyboardInterrupt:
        return Outcome(node, id, INTERRUPTED)


def check(expected, found):
    other = [f"{what} is {found.get(what)}, not {wanted}" for what, wanted in expected.items() if found.get(what) != wanted]
    if other:
        raise UserError(f"not what it is where the table runs: {'; '.join(other)}")


def _run(command, inputs, large, root):
    placed = {}
    at = lambda path: placed.get(path) or root / path.absolute().relative_to("/")
    for path, content in inputs.items():
        at(path).parent.mkdir(parents=True, exist_ok=True)
        at(path).write_bytes(content)
    for one in large:
        placed[one.path] = _fetched(one, root)
    for path in command.writes:
        at(path).parent.mkdir(parents=True, exist_ok=True)
    log = root / "log.txt"
    code = _finish(command.line(at), log)
    # Where a file lies here is of no use to the reader.
    output = log.read_text(errors="replace").replace(str(root), "")
    files = {}
    for path in command.writes:
        if at(path).is_file():
            content = at(path).read_bytes()
            if content != inputs.get(path):
                files[path] = (hashlib.sha256(content).hexdigest(), content)
    return code, output, files


def _fetched(large, root):
    import ray

    if large.path.is_file() and dataset.sha256(large.path) == large.sha256:
        return large.path
    there = root / large.path.name
    there.write_bytes(ray.get(large.sent[0]))
    return there


def _finish(line, log):
    """Runs a command to its end -> its exit code; an interrupt ends it in good order."""
    dying = ctypes.CDLL(None).prctl if sys.platform == "linux" else None
    # Where the node is lost, its command is begun anew elsewhere: what is left of it must not go on.
    tie = (lambda: dying(PR_SET_PDEATHSIG, signal.SIGKILL)) if dying else None
    with open(log, "wb") as file:
        streams = {"stdin": subprocess.DEVNULL, "stdout": file, "stderr": subprocess.STDOUT}
        process = subprocess.Popen(line, **streams, env=os.environ | ENVIRONMENT, start_new_session=True, preexec_fn=tie)
    try:
        while True:
            try:
                return process.wait(CHECK)
            except subprocess.TimeoutExpired:
                pass
    except KeyboardInterrupt:
        process.terminate()
        process.wait()
        return INTERRUPTED
