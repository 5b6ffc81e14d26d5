"""Family `skilldiffuser`: every `horizon` steps observations by denoising, and from them a queue of actions."""

from .family import ARGMAX, CODEBOOK, NOISE, Family


def step(twin):
    twin.run("high_level/step")
    if twin.decides:
        twin.select()
        twin.run("low_level/init")
        twin.repeat("low_level/denoise", twin.family["denoise"]["steps"])
        twin.run("low_level/inverse")
    twin.run("low_level/pop")


FAMILY = Family(step, ("horizon", *CODEBOOK, "denoise.steps"), {"decision": ARGMAX, "noise": NOISE})
