"""The commands of a job, each with all files that it reads and writes, so that another machine can run it.

Paths among the arguments are files and folders of the job, which lie elsewhere on another machine; strings mean the same on all. A command runs on
an *engine* (local, on_ray), which has `run(command)`, `evaluate(rollouts)`, `stop()` and `stopped`. What can fail: a command ends with an error, or
the engine was stopped.
"""

import os
import sys
from dataclasses import dataclass
from pathlib import Path

from ..config import UserError

# Sums of an export too depend on the number of threads, which PyTorch takes from the machine unless it is told.
ENVIRONMENT = {"OMP_NUM_THREADS": "1"}
INTERRUPTED = 130  # exit code of a command that kept its state


class Stopped(Exception):
    """The table was interrupted; what its commands have done is kept."""


@dataclass(frozen=True, eq=False)
class Command:
    program: str | None  # none: the exporter
    arguments: list
    reads: list  # of paths; of the files that a command also writes those that are there
    writes: list  # of paths, the one that says that it is done last
    log: Path  # gets all that it prints
    encoder: str | None = None  # the language encoder that it loads

    def line(self, at=lambda path: path):
        """Returns the command as it is typed where a file lies at `at(path)`."""
        program = [self.program] if self.program else [sys.executable, "-m", "lads_exporter"]
        return [*program, *(str(at(part) if isinstance(part, Path) else part) for part in self.arguments)]

    def failed(self, code, output, where=""):
        """Makes the error of a command that ended with an exit code; carries the last line of what it printed."""
        lines = output.strip().splitlines() or ["no output"]
        name = " ".join([os.path.basename(self.program or "lads_exporter"), str(self.arguments[0])])
        return UserError(f"{where}{name} ... failed ({code}): {lines[-1]}; all of it is in {self.log}")


@dataclass(frozen=True, eq=False)
class Rollouts:
    """Episodes of a bundle by a table's protocol, run by lads-run."""

    evaluation: object
    instructions: list  # ids, in the bundle's order
    bundle: Path
    results: Path
    lads_run: Path
    log: Path
    uniform: bool = False  # random actions instead of the policy's

    def command(self, results, instruction=None):
        """Makes the command that runs all of them, or those of one instruction, into a file."""
        asked = self.evaluation
        options = ["--model", self.bundle, "--episodes", asked.episodes, "--seed", asked.seed, "--noise", asked.noise, "--threads", 1, "--json", results]
        options += ["--instruction", instruction] if instruction else []
        options += ["--uniform"] if self.uniform else []
        return Command(str(self.lads_run), options, [self.bundle], [results], self.log)
