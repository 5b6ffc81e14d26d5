"""System `lads`: a categorical high level over a codebook that a trajectory encoder and the semantic regularisation made (Section 4).

Jointly by Algorithm 1, or in three stages. The stop-gradients of equation 7 keep the cross-entropy from moving the plans and the other
losses from moving the high level, so the stages minimise the same sum (equation 11) in turn:
1. `plans`: encoder, codebook, low level and semantic regularisation;
2. `low_level`: the low level alone, on the frozen codes of all windows;
3. `high_level`: the transformer alone, on the frozen codes of all windows.

LADS w/o SR is `alignment.weight = 0`. LADS w/o CP is `regressed = true`: the high level's head gives a plan, trained by the squared distance
to the code, and the nearest code is taken (Section 5.4); as logits, the distances are a linear head (`fold`).
"""

import copy

import torch
import torch.nn.functional as F

from .. import graphs
from ..codebook import nearest, perplexity
from ..model import Lads
from . import base
from .base import Exported
from .folding import fold


def head(setting):
    """Returns the number of the high level's outputs, None for logits over the codes."""
    return setting.config.encoder.codebook_dim if setting.config.system.regressed else None


def Networks(setting, encoded):
    return Lads(setting, encoded, head(setting))


class Training(base.Training):
    STAGES = {"joint": ("joint",), "staged": ("plans", "low_level", "high_level")}
    PARTS = {
        "joint": ("encoder", "low_level", "alignment", "high_level", "codebook"),
        "plans": ("encoder", "low_level", "alignment", "codebook"),
        "low_level": ("low_level",),
        "high_level": ("high_level",),
    }
    CODEBOOK = True

    def parts(self, stage):
        return self.PARTS[stage]

    def begin(self, stage):
        """Computes the codes of all windows, which stay fixed during the stage."""
        if stage in ("low_level", "high_level"):
            self.networks.eval()
            self.codes = self.corpus.codes(self.encode, range(len(self.corpus.lengths)))
        if stage == "high_level" and self.config.training.ce_at == "decisions":
            self.codes[:, torch.arange(self.corpus.steps) % self.corpus.horizon > 0] = -1

    def loss(self, stage, step):
        if stage == "low_level":
            return self._low_level_loss(self.generator(stage, step))
        if stage == "high_level":
            episodes = self.draw_alike(stage, step)
            ce, _ = self.high_level(episodes, self.codes[episodes.to(self.corpus.device)])
            return ce, {"ce": ce}
        return self._plans_loss(stage, step, self.generator(stage, step))

    def offsets(self, episodes, generator):
        if not self.config.training.random_offset:
            return torch.zeros(len(episodes), dtype=torch.long)
        return torch.randint(self.corpus.horizon, (len(episodes),), generator=generator)

    def segments(self, episodes, offsets):
        return self.corpus.segments(episodes, offsets)

    def starters(self):
        """The episodes whose segments start the codebook."""
        return self.corpus.train

    def plans(self, episodes, offsets):
        """Computes L_BC, the commitment term of L_VQ and L_align (equations 5, 6, 10); and the segments' codes [B, T].

        The code of a segment stands at the step at which it starts, -1 at all other steps.
        """
        networks, segments = self.networks, self.segments(episodes, offsets)
        latents = networks.encoder(segments.observations, segments.executed, segments.lengths)
        plans, index, commitment = networks.codebook(latents)
        losses = {"bc": self.cloning(segments, plans, episodes), "commitment": commitment}
        losses["align"] = self.align(plans, segments, episodes)
        codes = torch.full((len(episodes), self.corpus.steps), -1, dtype=torch.long, device=self.corpus.device)
        codes[segments.rows, segments.starts] = index
        return losses, codes

    def cloning(self, segments, plans, episodes):
        """Computes the mean squared error of the low level's actions under each segment's plan (equation 5)."""
        valid = segments.valid
        each = plans[:, None].expand(-1, self.corpus.horizon, -1)[valid]
        return F.mse_loss(self.networks.low_level(segments.low_level_observations[valid], each), segments.actions[valid])

    def align(self, plans, segments, episodes):
        """Computes L_align of the sequences of plans and their sentences (equation 10); 0 where it has no weight."""
        if self.config.alignment.weight == 0:
            return plans.new_zeros(())
        most = int(segments.places.max()) + 1
        sequence = plans.new_zeros(len(episodes), most, plans.shape[1])
        valid = torch.zeros(len(episodes), most, dtype=torch.bool, device=plans.device)
        sequence[segments.rows, segments.places] = plans
        valid[segments.rows, segments.places] = True
        instruction = self.corpus.instruction[episodes].to(plans.device)
        return self.networks.alignment(sequence, valid, self.corpus.sentences[instruction], instruction)

    def high_level(self, episodes, codes):
        """Computes L_CE (equation 8), or without CP the squared distance to the code; and the accuracy. codes [B, T] are the targets, -1
        where there is none."""
        high_level = self.networks.high_level
        words, codes, observations, executed = self.contexts.take(episodes, codes, high_level.training)
        with self.half():
            out = high_level(words, observations, executed)
        out, targets = out[codes >= 0], codes[codes >= 0]
        if self.config.system.regressed:
            known = self.networks.codebook.codes
            return F.mse_loss(out, known[targets]), (nearest(out, known) == targets).float().mean()
        return F.cross_entropy(out, targets), (out.argmax(-1) == targets).float().mean()

    def _low_level_loss(self, generator):
        episodes, steps, starts = self.corpus.draw_transitions(self.settings(self.config, "low_level").batch, generator)
        plans = self.networks.codebook.codes[self.codes[episodes, starts]]
        bc = F.mse_loss(self.networks.low_level(self.corpus.shown(episodes, steps), plans), self.corpus.actions[episodes, steps])
        return self.config.training.bc_weight * bc, {"bc": bc}

    def _plans_loss(self, stage, step, generator):
        if step == self.config.encoder.kmeans_step:
            self._start_codebook(generator)
        episodes = self.corpus.draw(self.settings(self.config, stage).batch, generator)
        offsets = self.offsets(episodes, generator)
        parts, codes = self.plans(episodes, offsets)
        total = self.config.training.bc_weight * parts["bc"] + parts["commitment"]
        total = total + self.config.alignment.weight * parts["align"]
        if self.networks.codebook.started:
            parts["perplexity"] = perplexity(codes[codes >= 0], len(self.networks.codebook.codes))
            if stage == "joint":
                if self.config.training.ce_at == "all":
                    codes = self.corpus.codes(self.encode, episodes.tolist())
                parts["ce"], _ = self.high_level(episodes, codes)
                total = total + parts["ce"]
        return total, parts

    @torch.no_grad()
    def _start_codebook(self, generator):
        latents = []
        for episodes in self.starters().split(64):
            segments = self.segments(episodes, self.offsets(episodes, generator))
            latents.append(self.networks.encoder(segments.observations, segments.executed, segments.lengths))
        self.networks.codebook.start(torch.cat(latents))

    @torch.no_grad()
    def encode(self, segments):
        latents = self.networks.encoder(segments.observations, segments.executed, segments.lengths)
        return nearest(latents, self.networks.codebook.codes)

    @torch.no_grad()
    def finish(self, stage):
        """Puts a policy's correction into its last layer, after the stage that trains it.

        High level: less what is frequent anyway, the logits say which plan the instruction speaks for. Low level: a gain.
        """
        if stage in ("joint", "high_level") and not self.config.system.regressed:
            uses = self.networks.codebook.uses
            self.networks.high_level.head.bias.sub_(self.config.high_level.balance * (uses / uses.sum()).log())
        if stage in ("joint", "low_level"):
            base.gain(self.actions_layer(), self.config.low_level.gain)

    def actions_layer(self):
        """Returns the low level's linear layer that gives the actions."""
        return self.networks.low_level.last

    @torch.no_grad()
    def validate(self, stage):
        """Computes losses on the held-out episodes, segmented from step 0."""
        episodes = self.corpus.validation
        self.networks.eval()
        parts, codes = self.plans(episodes, torch.zeros(len(episodes), dtype=torch.long))
        out = {"val_bc": float(parts["bc"])}
        if self.networks.codebook.started:
            out["val_perplexity"] = perplexity(codes[codes >= 0], len(self.networks.codebook.codes))
            if stage in ("joint", "high_level"):
                ce, accuracy = self.high_level(episodes, codes)
                out |= {"val_ce": float(ce), "val_accuracy": float(accuracy)}
        return out

    def summary(self):
        """Describes how the codebook is used over the dataset."""
        self.networks.eval()
        codes = self.corpus.codes(self.encode, range(len(self.corpus.lengths)))
        starts = codes[:, :: self.corpus.horizon]
        book = self.networks.codebook
        return {"perplexity": perplexity(starts[starts >= 0], len(book.codes)), "codebook_size": len(book.codes), "revived": int(book.revived)}


def family(setting):
    """Makes what the contract says of a policy with a codebook of plans that last H steps."""
    encoder = setting.config.encoder
    return {
        "kind": "lads",
        "horizon": encoder.horizon,
        "codebook": {"size": encoder.codebook_size, "dim": encoder.codebook_dim},
        "decision": base.decision(setting),
    }


def acting(networks, setting):
    """Returns networks whose high level gives logits over the codes."""
    if setting.config.system.regressed:
        networks = copy.deepcopy(networks)
        networks.high_level.head = fold(networks.high_level.head, None, networks.codebook.codes)
    return networks


def export(networks, setting, encoded):
    horizon = setting.config.encoder.horizon
    return Exported(graphs.build(acting(networks, setting), encoded, horizon), family(setting), segment=horizon)
