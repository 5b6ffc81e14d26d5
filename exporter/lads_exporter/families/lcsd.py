"""Family `lcsd`: a plan and an action at every step, the action by denoising."""

from .family import ARGMAX, CODEBOOK, NOISE, Family


def step(twin):
    twin.run("high_level/step")
    twin.select()
    twin.run("low_level/init")
    twin.repeat("low_level/denoise", twin.family["denoise"]["steps"])
    twin.run("low_level/act")


FAMILY = Family(step, (*CODEBOOK, "denoise.steps"), {"decision": ARGMAX, "noise": NOISE})
