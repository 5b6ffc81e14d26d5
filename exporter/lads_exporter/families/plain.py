"""Family `plain`: observation to action in one entry, with the states that the contract names."""

from .family import Family


def step(twin):
    twin.run("policy/act")


FAMILY = Family(step)
