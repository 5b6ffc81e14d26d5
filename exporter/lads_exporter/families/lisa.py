"""Family `lisa`: the low level is a transformer over the steps of the plan in force."""

from .family import ARGMAX, CODEBOOK, LOW_LEVEL, Family


def step(twin):
    twin.run("high_level/step")
    if twin.decides:
        twin.select()
        twin.clear("low_level")
        twin.run("low_level/start")
    else:
        twin.run("low_level/step")


FAMILY = Family(step, ("horizon", *CODEBOOK, *LOW_LEVEL), {"decision": ARGMAX})
