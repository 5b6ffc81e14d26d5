"""The engine of one machine: commands as processes, as many at a time as are asked for.

`stop` may be called by a signal's handler; it ends the processes in good order, and trainings keep their checkpoints.
"""

import os
import subprocess
import threading

from ..config import UserError
from .commands import ENVIRONMENT, INTERRUPTED, Stopped


class Local:
    def __init__(self, at_once=1):
        self.at_once = at_once
        self.running, self.stopped, self.lock = set(), False, threading.Lock()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def run(self, command):
        with self.lock:
            if self.stopped:
                raise Stopped
            with open(command.log, "ab") as file:
                line = command.line()
                try:
                    process = subprocess.Popen(line, stdout=file, stderr=subprocess.STDOUT, start_new_session=True, env=os.environ | ENVIRONMENT)
                except OSError as error:
                    raise UserError(f"{line[0]}: cannot be run ({error.strerror}); build it anew: cargo build --release -p lads-sim") from error
            self.running.add(process)
        code = process.wait()
        with self.lock:
            self.running.discard(process)
        if self.stopped or code == INTERRUPTED:
            raise Stopped
        if code:
            raise command.failed(code, command.log.read_text(errors="replace"))

    def evaluate(self, rollouts):
        """Runs all episodes; the results appear whole or not at all."""
        partial = rollouts.results.with_suffix(".partial")
        self.run(rollouts.command(partial))
        partial.replace(rollouts.results)

    def stop(self):
        with self.lock:
            self.stopped = True
            for process in self.running:
                process.terminate()
