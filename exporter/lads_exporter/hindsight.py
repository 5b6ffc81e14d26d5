"""Relabels trajectories in hindsight: a part of a trajectory is a demonstration of whatever it did.

Random trajectories with post-hoc labels do several things at once, and few of them do one rare thing alone. The
labelling rule does not depend on where a trajectory begins, and each of its clauses is true by itself. So each drawn
episode is the rest of a trajectory from some step on, labelled with one or several of the sub-tasks that it achieved,
rare ones as often as frequent ones, in the words and the random order of the dataset's labels. Only phrases of the
dataset's own labels are used.

Needs the environment's `[[sub_task]]` with `element`, `sign` and `threshold`: an element of the observation that changed
by more than the threshold.
"""

import dataclasses

import numpy as np

from .config import UserError

JOIN = " and "


def achieved(sub_tasks, start, end):
    """Finds which sub-tasks hold from observations `start` [N, O] to `end` [N, O]: bool [N, S]."""
    change = end.astype(np.float64) - start
    return np.stack([row["sign"] * change[:, row["element"]] > row["threshold"] for row in sub_tasks], 1)


def text(names, draw):
    """Makes the sentence for sub-tasks: those of one object share a clause, clauses and directions in random order."""
    clauses = {}
    for name in names:
        head, last = name.rsplit(" ", 1)
        clauses.setdefault(head if head.startswith("move ") else name, []).append(last)
    sentences = []
    for head, ways in clauses.items():
        sentences.append(head + " " + JOIN.join(draw.permutation(ways)) if head.startswith("move ") else head)
    return JOIN.join(draw.permutation(sentences))


def relabel(dataset, setting, count, latest, most, seed):
    """Draws `count` episodes from equally long trajectories: a Dataset with texts of its own.

    They start at a step up to `latest` (half of them at 0) and have up to `most` sub-tasks each. Episodes of the
    trajectories that are held out stand at the places that `Corpus` holds out.
    """
    sub_tasks = [row for row in setting.environment.get("sub_task", []) if "threshold" in row]
    if not sub_tasks:
        raise UserError(f"{setting.config.environment}: data.hindsight needs [[sub_task]] with element, sign and threshold")
    lengths = dataset.lengths()
    if len(set(lengths)) != 1:
        raise UserError("data.hindsight needs trajectories of one length")
    length, draw, every = int(lengths[0]), np.random.default_rng(seed), setting.config.data.validation_every
    trajectories = dataset.observations.reshape(len(dataset), length, -1)
    held_out = np.arange(len(dataset)) % every == every - 1
    shares = achieved(sub_tasks, trajectories[:, 0], trajectories[:, -1]).mean(0)
    rarity = 1 / np.maximum(shares, 0.01)
    places = np.arange(count) % every == every - 1
    rows, starts, labels, index = np.zeros(count, int), np.zeros(count, int), np.zeros(count, int), {}
    for among, to in ((held_out, places), (~held_out, ~places)):
        episodes = np.repeat(np.flatnonzero(among), 2)
        begins = draw.integers(1, latest + 1, len(episodes))
        begins[::2] = 0
        done = achieved(sub_tasks, trajectories[episodes, begins], trajectories[episodes, -1])
        weight = (done * rarity).max(1)
        chosen = draw.choice(len(episodes), to.sum(), p=weight / weight.sum())
        rows[to], starts[to] = episodes[chosen], begins[chosen]
        for place, which in zip(np.flatnonzero(to), chosen):
            options = np.flatnonzero(done[which])
            size = min(len(options), 1 + min(draw.geometric(0.6) - 1, most - 1))
            share = rarity[options] / rarity[options].sum()
            names = [sub_tasks[i]["name"] for i in draw.choice(options, size, replace=False, p=share)]
            labels[place] = index.setdefault(text(names, draw), len(index))
    at = np.concatenate([np.arange(row * length + start, (row + 1) * length) for row, start in zip(rows, starts)])
    part = lambda array: None if array is None else array[at]
    return dataclasses.replace(
        dataset,
        observations=part(dataset.observations),
        states=part(dataset.states),
        actions=part(dataset.actions),
        executed=part(dataset.executed),
        frame_rows=part(dataset.frame_rows),
        offsets=np.cumsum([0, *(length - starts)]),
        instruction=labels,
        texts=list(index),
    )
