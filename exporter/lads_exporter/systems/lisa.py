"""System `lisa`: a high level on words and observations that regresses an option every H steps, quantised; a transformer on the steps of
its chunk acts.

Trained end to end: mean squared error of the actions plus commitment. Of an option's H copies the first carries its gradient, as in the published
code, or all do. Departures: the language encoder is frozen; trajectories are padded at their end, chunks start at step 0, and what is padded
counts nowhere, not in the quantiser either; unused codes are revived; the high level keeps its whole history when it acts. At export the
head, the projection and the distances to the codes become one linear layer, and projection and option embedding one table.
"""

import copy
import dataclasses

import torch
import torch.nn.functional as F
from torch import nn

from ..codebook import Codebook, perplexity
from ..kinds import common, lisa
from ..model import Normalizer
from . import base
from .base import Exported
from .folding import fold

START_BATCHES = 8  # whose latents the codebook starts from


def chunk_sizes(setting, encoded):
    """Returns the low level's sizes: it has a time for every step of a chunk, also where the context ends within one."""
    sizes = base.sizes(setting, encoded)
    whole = -(-sizes.steps // sizes.horizon) * sizes.horizon
    return dataclasses.replace(sizes, steps=whole)


class Quantised(nn.Module):
    """High level whose head regresses a vector of `hidden` elements, projected into the codebook's space, quantised, and projected back."""

    def __init__(self, setting, encoded):
        super().__init__()
        sizes = base.sizes(setting, encoded)
        self.normalizer = Normalizer(sizes.observation)
        self.high_level = common.high_level(sizes, sizes.hidden, actions=False)
        self.project_in = nn.Linear(sizes.hidden, sizes.plan)
        self.codebook = Codebook(setting.config.encoder)

    def folded(self):
        """Returns the high level with logits over the codes."""
        acting = copy.deepcopy(self.high_level)
        acting.head = fold(acting.head, self.project_in, self.codebook.codes)
        return acting


class Networks(Quantised):
    def __init__(self, setting, encoded):
        super().__init__(setting, encoded)
        sizes = chunk_sizes(setting, encoded)
        self.project_out = nn.Linear(sizes.plan, sizes.hidden)
        self.low_level = lisa.ChunkPolicy(sizes, nn.Linear(sizes.hidden, sizes.hidden))

    def option_table(self):
        """Computes the options of all codes [M, d], before the low level embeds them."""
        return self.project_out(self.codebook.codes)


class Training(base.Training):
    CODEBOOK = True
    PARTS = ("high_level", "project_in", "codebook", "project_out", "low_level")

    def parts(self, stage):
        return self.PARTS

    def latents(self, episodes, every):
        """Encodes the episodes' contexts cut into chunks of `every` steps: latents [N, D] at each one's start, and what it is of
        (`Chunks`)."""
        networks = self.networks
        words, places, observations, executed = self.contexts.take(episodes, self.contexts.places(episodes), networks.high_level.training)
        with self.half():
            regressed = networks.high_level(words, observations)
        chunks = Chunks(places, observations, executed, every)
        return networks.project_in(regressed[:, ::every][chunks.kept]), chunks

    def chunks(self, episodes):
        """Computes the losses of chunks of H steps, and their codes."""
        networks, config = self.networks, self.config.system
        latents, chunks = self.latents(episodes, self.corpus.horizon)
        plans, index, commitment = networks.codebook(latents)
        options = copies(networks.project_out(plans), self.corpus.horizon, config.option_gradient)
        with self.half():
            actions = networks.low_level.chunks(networks.low_level.embed_option(options), chunks.starts, chunks.observations, chunks.executed)
        valid = chunks.places >= 0
        targets = self.corpus.actions.flatten(0, 1)[chunks.places[valid]]
        return {"bc": F.mse_loss(actions[valid], targets), "commitment": commitment}, index

    def loss(self, stage, step):
        if step == self.config.encoder.kmeans_step:
            self.start_codebook(stage, step, self.corpus.horizon)
        parts, index = self.chunks(self.draw_alike(stage, step))
        total = self.config.training.bc_weight * parts["bc"] + parts["commitment"]
        return total, parts | self.use(index)

    def use(self, index):
        book = self.networks.codebook
        return {"perplexity": perplexity(index, len(book.codes))} if book.started else {}

    @torch.no_grad()
    def start_codebook(self, stage, step, every):
        found = [self.latents(self.draw_alike(stage, step + ahead), every)[0] for ahead in range(START_BATCHES)]
        self.networks.codebook.start(torch.cat(found))

    def finish(self, stage):
        base.gain(self.networks.low_level.head, self.config.low_level.gain)

    @torch.no_grad()
    def validate(self, stage):
        self.networks.eval()
        parts, index = self.chunks(self.held_out())
        return {"val_bc": float(parts["bc"]), "val_perplexity": perplexity(index, len(self.networks.codebook.codes))}

    @torch.no_grad()
    def summary(self):
        self.networks.eval()
        index = self.networks.codebook(self.latents(self.held_out(), self.every)[0])[1]
        book = self.networks.codebook
        return {"perplexity": perplexity(index, len(book.codes)), "codebook_size": len(book.codes), "revived": int(book.revived)}

    @property
    def every(self):
        """Returns the control steps from one option to the next in training."""
        return self.corpus.horizon


class Chunks:
    """Contexts cut into chunks of H steps from their first one on; those whose first step counts.

    `kept` [R, S] says which; of these N: `places` [N, H] (-1 where there is nothing to learn), `observations`, `executed`, `starts` [N].
    """

    def __init__(self, places, observations, executed, horizon):
        more = -places.shape[1] % horizon
        places = F.pad(places, (0, more), value=-1).unflatten(1, (-1, horizon))
        self.kept = places[:, :, 0] >= 0
        self.places = places[self.kept]
        self.observations, self.executed = (F.pad(x, (0, 0, 0, more)).unflatten(1, (-1, horizon))[self.kept] for x in (observations, executed))
        self.starts = self.kept.nonzero()[:, 1] * horizon


def copies(options, count, gradient):
    """Repeats options [N, d] -> [N, count, d], of which only the first, or all, carry the gradient."""
    if gradient == "all":
        return options[:, None].expand(-1, count, -1)
    return torch.cat([options[:, None], options.detach()[:, None].expand(-1, count - 1, -1)], 1)


@torch.no_grad()
def acting(networks, setting, encoded):
    """Returns the policy that acts, its quantiser folded."""
    sizes = base.sizes(setting, encoded)
    policy = lisa.Lisa(sizes)
    policy.normalizer.load_state_dict(networks.normalizer.state_dict())
    policy.high_level = networks.folded()
    trained = networks.low_level.state_dict()
    state = {name: value for name, value in trained.items() if not name.startswith("embed_option")}
    state["embed_option.weight"] = networks.low_level.embed_option(networks.option_table())
    state["embed_timestep.weight"] = trained["embed_timestep.weight"][: sizes.steps]
    policy.low_level.load_state_dict(state)
    return base.with_eyes(policy, networks).eval()


def export(networks, setting, encoded):
    sizes = base.sizes(setting, encoded)
    return Exported(lisa.build(acting(networks, setting, encoded), sizes), lisa.family(sizes, base.decision(setting)))
