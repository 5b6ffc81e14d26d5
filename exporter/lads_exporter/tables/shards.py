"""Puts the results of an evaluation together that ran instruction by instruction: the numbers of a run of all of them, to the last bit.

Latencies and times stay out: they are of the machines. So do the rates of sub-tasks in a split, which the instructions tell. What can fail: parts
that are not of one evaluation, or not all of them.
"""

import math

from ..config import UserError
from .render import K_RATES, wilson

OWN = ("instructions", "splits", "latency_us", "time")  # of a part; all else is the same in all


def merge(parts, instructions):
    """Merges results that lads-run wrote, one for each instruction; `instructions` are the ids that there must be, in their order."""
    rows = [row for part in parts for row in part["instructions"]]
    if [row["id"] for row in rows] != instructions:
        raise UserError(f"an evaluation's parts are of {', '.join(row['id'] for row in rows)}, not of {', '.join(instructions)}")
    head = {key: value for key, value in parts[0].items() if key not in OWN}
    for part in parts[1:]:
        other = [key for key in head if part.get(key) != head[key]]
        if other:
            raise UserError(f"an evaluation's parts differ in {', '.join(other)}: {part.get(other[0])!r} and {head[other[0]]!r}")
    splits = {name: _score([run for row in rows if row["split"] == name for run in row["runs"]]) for name in parts[0]["splits"]}
    return head | {"splits": splits, "instructions": rows}


def _score(runs):
    """Scores episodes as `Score::of` in sim-harness/proof/src/metrics.rs does: whole numbers are summed, and divided once."""
    count = len(runs)
    done = [sum(row["commanded"] for row in run["completions"]) for run in runs]
    full = sum(run["success"] for run in runs)
    at_least = [sum(completed > k for completed in done) for k in range(K_RATES)]
    share = lambda some: some / count if count else None
    return {
        "episodes": count,
        "n_rate": share(sum(done)),
        "n_rate_standard_error": _standard_error(done),
        "k_rate": [share(some) for some in at_least],
        "k_rate_interval": [wilson(some, count) for some in at_least],
        "full_success": share(full),
        "full_success_interval": wilson(full, count),
        "full_success_count": full,
        "un_instructed": sum(len(run["completions"]) for run in runs) - sum(done),
    }


def _standard_error(done):
    n = len(done)
    if n < 2:
        return None
    return math.sqrt(float(n * sum(x * x for x in done) - sum(done) ** 2) / n / (n - 1.0) / n)
