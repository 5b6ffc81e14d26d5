"""Small random policies, one for each family and form of state that the runtime knows: `python -m lads_exporter random --kind K`.

A kind is a module's three functions: the networks in PyTorch with random weights, the entry graphs made of them, the contract.
"""

from dataclasses import dataclass
from typing import Callable

import torch

from .. import bundle, random_policy
from ..config import UserError
from . import common, frozen, history, images, lads, lang_dt, lcsd, lisa, plain, sighted, sighted_history, skilldiffuser, vae
from .common import Sizes


@dataclass(frozen=True)
class Kind:
    policy: Callable  # sizes, seed -> the networks
    build: Callable  # networks, sizes -> the entry graphs as an ONNX model
    contract: Callable  # sizes, seed -> the contract
    sizes: Sizes = Sizes()


def _of(network, build, contract, sizes=Sizes()):
    return Kind(lambda sizes, seed: common.randomize(network(sizes), seed), build, contract, sizes)


def _images(name, cameras, hidden, sizes=Sizes(steps=12)):
    contract = lambda sizes, seed: images.contract(cameras, seed, name)
    return Kind(lambda sizes, seed: images.randomize(images.Images(cameras, hidden), seed), images.build, contract, sizes)


def _seeing(eyes, network, build, family, noise=None):
    """Makes the kind of a family on what an encoder hands on; `eyes` is the module `sighted` or `frozen`."""
    sizes = Sizes(observation=eyes.HANDED)
    contract = lambda sizes, seed: eyes.contract_of(family(sizes), sizes, seed, noise)
    return Kind(lambda sizes, seed: eyes.of_kind(network(sizes), seed), build, contract, sizes)


KINDS = {
    "lads": Kind(lads.policy, lads.build, lads.contract),
    "lang_dt": _of(lang_dt.LangDt, lang_dt.build, lang_dt.contract),
    "lisa": _of(lisa.Lisa, lisa.build, lisa.contract),
    "vae": _of(vae.Vae, vae.build, vae.contract),
    "lcsd": _of(lcsd.Lcsd, lcsd.build, lcsd.contract),
    "skilldiffuser": _of(skilldiffuser.SkillDiffuser, skilldiffuser.build, skilldiffuser.contract, Sizes(horizon=7, steps=42)),
    "history": _of(history.History, history.build, history.contract),
    "vae_history": _of(vae.VaeHistory, vae.build_history, vae.contract_history),
    "plain": _of(plain.Plain, plain.build_plain, plain.contract),
    "recurrent": _of(plain.Recurrent, plain.build_recurrent, plain.contract_recurrent),
    "stacked": _of(plain.Stacked, plain.build_stacked, plain.contract_stacked),
    "camera": _of(plain.Camera, plain.build_camera, plain.contract_camera),
    "images": _images("images", images.SMALL, (32,)),
    "sighted": Kind(sighted.policy, lads.build, sighted.contract),
    "sighted_lang_dt": _seeing(sighted, lang_dt.LangDt, lang_dt.build, lambda sizes: {"kind": "lang_dt"}),
    "sighted_lisa": _seeing(sighted, lisa.Lisa, lisa.build, lambda sizes: lisa.family(sizes, common.argmax())),
    "sighted_vae": _seeing(sighted, vae.Vae, vae.build, lambda sizes: vae.family(sizes, "sample", 0), [Sizes().plan]),
    "frozen_lang_dt": _seeing(frozen, lang_dt.LangDt, lang_dt.build, lambda sizes: {"kind": "lang_dt"}),
    "frozen_lisa": _seeing(frozen, lisa.Lisa, lisa.build, lambda sizes: lisa.family(sizes, common.argmax())),
    "frozen_vae_history": _seeing(frozen, vae.VaeHistory, vae.build_history, lambda sizes: vae.family_history(sizes, "sample", 0), [Sizes().plan]),
    "sighted_history": Kind(sighted_history.policy, sighted_history.build, sighted_history.contract),
}
# Of the sizes that encoders have in the field.
LARGE = {name: _images(name, *parts, Sizes(steps=4)) for name, parts in images.SIZES.items()}


def export(name, seed=0):
    """Makes a random policy of a kind -> the networks in PyTorch, the complete bundle."""
    known = KINDS | LARGE
    if name not in known:
        raise UserError(f"--kind {name}: unknown; known: {', '.join(known)}")
    kind = known[name]
    torch.manual_seed(seed)  # of what PyTorch starts weights with that are not drawn anew
    policy = kind.policy(kind.sizes, seed)
    found = kind.contract(kind.sizes, seed)
    known = len(found.get("instructions", []))
    steps = kind.sizes.steps
    candidates = ((tried % known if known else None, random_policy.channels(found, steps, seed + tried)) for tried in range(1, 200))
    return policy, bundle.seal(kind.build(policy, kind.sizes), found, candidates)
