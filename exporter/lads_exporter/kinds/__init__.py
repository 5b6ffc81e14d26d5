"""Small random policies, one for each family and form of state that the runtime knows: `python -m lads_exporter random --kind K`.

A kind is a module's three functions: the networks in PyTorch with random weights, the entry graphs made of them, the contract.
"""

from dataclasses import dataclass
from typing import Callable

from .. import bundle, random_policy
from ..config import UserError
from . import common, lads, plain
from .common import Sizes


@dataclass(frozen=True)
class Kind:
    policy: Callable  # sizes, seed -> the networks
    build: Callable  # networks, sizes -> the entry graphs as an ONNX model
    contract: Callable  # sizes, seed -> the contract
    sizes: Sizes = Sizes()


def _of(network, build, contract, sizes=Sizes()):
    return Kind(lambda sizes, seed: common.randomize(network(sizes), seed), build, contract, sizes)


KINDS = {
    "lads": Kind(lads.policy, lads.build, lads.contract),
    "plain": _of(plain.Plain, plain.build_plain, plain.contract),
    "recurrent": _of(plain.Recurrent, plain.build_recurrent, plain.contract_recurrent),
    "stacked": _of(plain.Stacked, plain.build_stacked, plain.contract_stacked),
}


def export(name, seed=0):
    """-> the networks in PyTorch, the complete bundle."""
    if name not in KINDS:
        raise UserError(f"--kind {name}: unknown; known: {', '.join(KINDS)}")
    kind = KINDS[name]
    policy = kind.policy(kind.sizes, seed)
    found = kind.contract(kind.sizes, seed)
    known = len(found.get("instructions", []))
    steps = kind.sizes.steps
    candidates = ((tried % known if known else None, random_policy.channels(found, steps, seed + tried)) for tried in range(1, 200))
    return policy, bundle.seal(kind.build(policy, kind.sizes), found, candidates)
