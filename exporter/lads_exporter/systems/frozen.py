"""Systems on a frozen encoder's features of a camera's frames, behind the first elements of the state: what they have beside those on states.

The features were made once (`python -m lads_exporter features`); the corpus gives them normalised and clipped, as the encoder's entry hands them on.
"""

from functools import cache
from types import SimpleNamespace

from .. import encoders
from ..config import UserError
from ..kinds import frozen
from .base import Exported


class Seeing:
    """Puts the encoder that made the features into the networks: put before a system's training among the bases of a class."""

    def __init__(self, networks, corpus, setting, seed_of):
        super().__init__(networks, corpus, setting, seed_of)
        seen = setting.config.pretrained
        encoder, sha256 = encoders.load(seen.encoder, seen.channel, setting.rendering["size"])
        if sha256 != corpus.encoder_sha256:
            raise UserError(f"the features were made by other weights of {seen.encoder}; make them anew with python -m lads_exporter features")
        networks.frames.network.load_state_dict(encoder.state_dict())
        networks.frames.normalizer.mean.copy_(corpus.seen_mean)
        networks.frames.normalizer.std.copy_(corpus.seen_std)


@cache
def of(system):
    """Makes the module of a system on features from that of the system on states."""

    def networks(setting, encoded):
        return frozen.give_eyes(system.Networks(setting, encoded), setting)

    def export(networks, setting, encoded):
        made = system.export(networks, setting, encoded)
        return Exported(made.model, made.family | {"features": setting.observation_len}, made.noise)

    return SimpleNamespace(Networks=networks, Training=type("Training", (Seeing, system.Training), {}), export=export)
