"""Makes other endings for instructions: what is asked for later cannot matter yet.

An instruction names its sub-tasks in the order in which they are done, joined by " and ". While the first
phrases are carried out the later ones may be any others: the plan does not depend on them. So in training
some trajectories get an instruction with the same beginning and another ending, and only the early steps
count. From a few dozen instructions this makes thousands, on which the high level learns to follow the
phrase at hand instead of recognising the whole instruction. It needs no labels of sub-tasks. No text of a
real instruction, seen or unseen, is made this way.
"""

import random

import torch

from . import language

JOIN = " and "


def texts(instructions, variants, seed=0):
    """Makes the texts of other endings: instructions -> {(index of a seen one among all, phrases kept): other texts with the same first
    phrases}."""
    seen = {index: row["text"].split(JOIN) for index, row in enumerate(instructions) if row["split"] == "seen"}
    phrases = sorted({phrase for row in seen.values() for phrase in row})
    real = {row["text"] for row in instructions}
    draw = random.Random(seed)
    made = {}
    for index, row in seen.items():
        for kept in range(1, len(row)):
            others = [phrase for phrase in phrases if phrase not in row[:kept]]
            if len(others) < len(row) - kept:
                continue
            found = {JOIN.join(row[:kept] + draw.sample(others, len(row) - kept)) for _ in range(variants)}
            if found - real:
                made[index, kept] = sorted(found - real)
    return made


class Endings:
    """Word embeddings of instructions with other endings, drawn at random for a trajectory."""

    def __init__(self, setting, device):
        data = setting.config.data
        self.rate, self.margin = data.ending_rate, data.ending_margin
        made = texts(setting.instructions, data.ending_variants) if self.rate > 0 else {}
        every = sorted({text for group in made.values() for text in group})
        encoded = language.encode(setting.config.language, every).instructions if every else []
        words = {text: torch.from_numpy(row.words).to(device) for text, row in zip(every, encoded)}
        self.phrases = [len(row["text"].split(JOIN)) for row in setting.instructions]
        self.words = {key: [words[text] for text in group] for key, group in made.items()}

    def draw(self, instruction, length):
        """Draws words of another ending and the number of first steps that count, or None for the real instruction."""
        kept = int(torch.randint(1, max(2, self.phrases[instruction]), ()))
        group = self.words.get((instruction, kept))
        if group is None or torch.rand(()) >= self.rate:
            return None
        steps = int(length * (kept - self.margin) / self.phrases[instruction])
        return (group[int(torch.randint(len(group), ()))], steps) if steps > 0 else None
