"""Runs all jobs of a table, some at a time on this machine or on a cluster, and writes the numbers of those that are finished.

A job is finished if its files are here, or if tables.json has its numbers from the same inputs. After every job the tables are written anew, so
that a reader always sees what is known. An interrupt stops trainings at their next step, in their checkpoints.
"""

import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path

from safetensors import SafetensorError

from .. import config, dataset, features as feature_file, frames as frame_file
from ..config import UserError
from . import render
from .commands import Stopped
from .definition import load
from .jobs import Place, all_jobs, checked_results
from .local import Local


def duration(seconds):
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min"


class Progress:
    """Prints one line per event, with the time that is left by what the finished jobs took."""

    def __init__(self, count, done):
        self.count, self.done, self.took = count, done, []

    def finished(self, label, seconds):
        self.done += 1
        self.took.append(seconds)
        self.say(f"{label}: finished in {duration(seconds)}")

    def say(self, text):
        left = self.count - self.done
        guess = f"; about {duration(left * sum(self.took) / len(self.took))} of work left" if self.took and left else ""
        print(f"[{self.done}/{self.count}] {text}{guess}", flush=True)


@contextmanager
def _stoppable(engine):
    def handler(number, frame):
        engine.stop()

    before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)


def floor(table, place, jobs, engine):
    """Evaluates uniform random actions in the same episodes: needs a bundle for its limits, whichever is here."""
    path = place.runs / table.name / "uniform.results.json"
    if not path.is_file():
        job = next((job for job in jobs if job.finished), None)
        if job is None:
            return None
        engine.evaluate(job.rollouts(path, uniform=True))
    return checked_results(table, path)


def open_engine(name, place, at_once):
    """Makes the engine that runs the jobs' commands; Ray is imported where it is asked for only."""
    if name == "local":
        return Local(at_once or 1)
    from .on_ray import OnRay

    return OnRay(place, at_once)


def run(path, data=None, frames=None, features=None, runs="runs/tables", lads_run="target/release/lads-run", models="models", at_once=None, engine="local", device="cpu"):
    """Runs a table's file to its end, or until it is stopped -> whether it reached the end."""
    if at_once is not None and at_once < 1:
        raise UserError(f"--jobs {at_once}: must be at least 1")
    if device != "cpu" and engine != "local":
        raise UserError(f"--device {device}: the engine {engine} gives its tasks a CPU each; leave --device out, or use --engine local")
    table = load(path)
    place = _place(table, data, {"frames": frames, "features": features}, runs, lads_run, models, device)
    jobs = all_jobs(table, place)
    with open_engine(engine, place, at_once) as opened:
        return _run(table, place, jobs, models, opened)


def _run(table, place, jobs, models, engine):
    known, uniform, others = render.recorded(models, table, jobs)
    groups = {}
    for job in jobs:
        groups.setdefault(job.folder, []).append(job)
    here = {job: job.numbers() for job in jobs if job.finished}
    progress = Progress(len(jobs), len(known | here))
    progress.say(f"{table.title}: jobs in {place.runs / table.name}")
    if known:
        progress.say(f"{len(known)} jobs have their numbers in {models}/{render.JSON}, from the same inputs")
    if others:
        progress.say(f"{others} jobs in {models}/{render.JSON} had other inputs and leave the table")
    known |= here
    failures, writing = [], threading.Lock()

    def write():
        with writing:
            scores = uniform or floor(table, place, jobs, engine)
            render.write(models, table, place, [(job, known.get(job)) for job in jobs], scores)

    def work(group):
        for job in group:
            if job in known or engine.stopped:
                continue
            begun = time.monotonic()
            try:
                progress.say(f"{job.label}: begins")
                job.run(engine)
                known[job] = job.numbers()
                progress.finished(job.label, time.monotonic() - begun)
                write()
            except Stopped:
                return
            except UserError as error:
                failures.append(f"{job.label}: {error}")
                progress.say(f"{job.label}: {error}")

    with _stoppable(engine), ThreadPoolExecutor(engine.at_once) as pool:
        left = [pool.submit(work, group) for group in groups.values()]
        while left:
            # Python runs a handler in the main thread only, which the system may leave asleep: it may interrupt another thread instead.
            done, left = wait(left, timeout=0.2)
            for outcome in done:
                outcome.result()
        if not engine.stopped:
            write()
    if failures:
        raise UserError(f"{len(failures)} of {len(jobs)} jobs failed:\n  " + "\n  ".join(failures))
    return not engine.stopped


def _place(table, data, given, runs, lads_run, models, device):
    data = Path(data) if data else table.path(table.data)
    named = {"frames": table.frames, "features": table.features}
    seen = {what: Path(given[what]) if given[what] else table.path(named[what]) for what in named if given[what] or named[what]}
    lads_run = Path(lads_run)
    problems = []
    if not data.is_file():
        problems.append(f"no dataset at {data}; collect one first (make collect ENV={table.name})")
    else:
        try:
            render.expert(data)
        except (SafetensorError, OSError, ValueError, AttributeError) as error:
            problems.append(f"{data}: no dataset of lads-collect ({error}); collect one (make collect ENV={table.name})")
    for option, folder in (("--runs", runs), ("--models", models)):
        if Path(folder).exists() and not Path(folder).is_dir():
            problems.append(f"{option} {folder}: it is no folder; name one")
    if not lads_run.is_file():
        problems.append(f"no program at {lads_run}; build it first: cargo build --release -p lads-sim")
    advice = {"frames": f"draw them first (make frames DATA={data})", "features": "make them first (python -m lads_exporter features)"}
    for what, path in seen.items():
        if not named[what]:
            problems.append(f"{table.name} has no systems that learn from {what}; leave --{what} out")
        elif not path.is_file():
            problems.append(f"no {what} at {path}; {advice[what]}")
    if problems:
        raise UserError("; ".join(problems))
    sha256 = dataset.sha256(data)
    made_of = None
    if "frames" in seen:
        made_of = frame_file.read(seen["frames"], sha256)[1]
    elif "features" in seen:
        setting = config.load(*table.configuration(table.tracks[0], table.rows(table.tracks[0])[0]))
        found = feature_file.read(seen["features"], setting, sha256)
        made_of = [found.rendering, found.encoder]
    seen = {what: path.resolve() for what, path in seen.items()}
    return Place(Path(runs).resolve(), data.resolve(), sha256, lads_run.resolve(), **seen, seen=made_of, device=device)
