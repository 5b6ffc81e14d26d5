"""What a family is to the exporter, and what several of them share."""

from dataclasses import dataclass, field
from typing import Callable

CODEBOOK = ("codebook.size", "codebook.dim")
LOW_LEVEL = ("low_level.layers", "low_level.heads", "low_level.head_dim")
ARGMAX, MEAN, NOISE = ("argmax", "sample"), ("mean", "sample"), ("seeded", "zero")  # rules of a decision from logits, from a distribution; of noise


@dataclass(frozen=True)
class Family:
    step: Callable  # runs the entries of a control step on a twin, in the controller's order
    lengths: tuple = ()  # fields of the contract's `family` that are positive lengths, dotted
    rules: dict = field(default_factory=dict)  # field with a `rule` and a `seed` -> its rules
    optional: tuple = ()  # lengths that are asked for where the contract has their field
    rings: Callable = lambda family: {}  # the contract's `family` -> rows of each state that is a ring

    @property
    def fields(self):
        """Returns the fields that a contract of the family must have, each once."""
        return list(dict.fromkeys(name.split(".")[0] for name in (*self.lengths, *self.rules)))


def first_or_later(twin):
    """Runs the high level's token of this step: the first has no action before it."""
    twin.run("high_level/start" if twin.timestep == 0 else "high_level/step")


def recall(twin):
    """Runs a low level that remembers a window of steps: under a new plan it reads them again."""
    if twin.decides:
        twin.clear("low_level")
        twin.run("low_level/plan")
        twin.repeat("low_level/recall", len(twin.states["row"].rows), ring="row")
    twin.run("low_level/step")
    twin.run("memory/append")
