"""Family `lads`: every `horizon` steps a plan is selected from the history; the low level acts on it and the observation."""

from .family import ARGMAX, CODEBOOK, Family, first_or_later


def step(twin):
    first_or_later(twin)
    if twin.decides:
        twin.select()
        twin.run("codebook/lookup")
    twin.run("low_level/act")


FAMILY = Family(step, ("horizon", *CODEBOOK), {"decision": ARGMAX})
