"""Policies as they were trained: at a decision their networks read the words and the whole history from its beginning, in PyTorch.

There is no KV cache, no exported graph and no folded layer: a quantised plan is the code nearest to what the high level regresses. Shared with
what is exported are the weights and the stream of noise. `of` makes the policy of a bundle: from its training run, or of the family `lads`
from the bundle's own initializers. What can fail: a run that is another bundle's, and an episode longer than a context that may not restart.
"""

import copy

import numpy as np
import torch
from onnx import numpy_helper
from torch import nn

from . import contract as contracts, language, systems, training, twin, weights
from .config import UserError
from .kinds.vae import LOG_STD
from .normals import Normals

NOISE_STREAM = 5  # of an episode's random streams, as lads-run numbers them


def noise_seed(entropy):
    """Computes the seed of the noise of an episode from (seed, instruction, episode), as lads-run does."""
    return int(np.random.default_rng([*entropy, NOISE_STREAM]).random() * 2.0**53)


class Whole:
    """A policy and its history; a subclass says what it decides and how it acts."""

    def __init__(self, networks, contract, words):
        """Makes the policy; `words` is one tensor [L, E] per instruction."""
        self.networks, self.contract, self.words = networks.eval(), contract, words
        self.low, self.high = (torch.tensor(side, dtype=torch.float32) for side in contracts.limits(contracts.action(contract)))
        self.channels = [row["name"] for row in contracts.seen(contract) if row]  # in the order in which networks take them
        self.seeded = isinstance(twin.noise_source(contract), Normals)
        self.codes = None  # [M, D] of a policy whose trajectory encoder names one

    def start(self, instruction, seed=None):
        """Begins an episode; `seed` is that of its noise."""
        self.instruction, self.normals = instruction, Normals(seed) if self.seeded else None
        self.observations, self.actions = [], []
        self.before = torch.zeros(len(self.low))  # the action before the context's first step
        self.plans, self.margins, self.logits, self.decided_at = [], [], [], []
        self.vector, self.vectors = None, []
        self.steps = 0

    @torch.no_grad()
    def act(self, seen):
        """Acts on what it sees -> action [A] float32, clipped to the contract's limits.

        seen: {channel: an observation [O] float32, or a frame [r, c, 3] of bytes}, or the array itself where there is one channel.
        """
        if len(self.observations) == self.contract["context"]["steps"]:
            if self.contract["context"]["beyond"] != "restart":
                raise UserError("an episode is longer than the policy's context, and its contract says to refuse")
            self.before = self.actions[-1]
            self.observations, self.actions = [], []
        if not isinstance(seen, dict):
            seen = dict(zip(self.channels, [seen], strict=True))
        self.observations.append(self.read(*(torch.from_numpy(seen[name]) for name in self.channels)))
        if (len(self.observations) - 1) % contracts.period(self.contract) == 0:
            self.decide()
        action = torch.clamp(self.action(), self.low, self.high)
        if self.vector is not None:
            self.vectors.append(self.vector)
        self.actions.append(action)
        self.steps += 1
        return action.numpy()

    def read(self, *seen):
        """Normalises what the policy sees: an observation, or what an encoder makes of a frame and of the observation beside it."""
        if hasattr(self.networks, "frames"):
            return self.networks.normalizer(self.networks.frames(*(part[None] for part in seen))[0])
        return self.networks.normalizer(*seen)

    def decide(self):
        """Decides what is in force from this step on."""

    def action(self):
        """Computes the action of the present step [A]."""
        raise NotImplementedError

    def remembering(self, plan):
        """Computes the action of a low level on a plan, a window of steps before it and those since."""
        low, steps = self.networks.low_level, (len(self.observations) - 1) % contracts.period(self.contract) + 1
        previous = torch.stack([self.before, *self.actions])
        window = min(len(self.observations) - steps, low.window)
        return low(plan, torch.stack(self.observations), window, previous, steps)[-1]

    def select(self, logits):
        """Records the decision for the largest of logits [M]."""
        best = logits.topk(2).values
        self.plans.append(int(logits.argmax()))
        self.margins.append(float(best[0] - best[1]))
        self.logits.append(logits)
        self.decided_at.append(self.steps)

    def draw(self, *shape):
        """Draws the noise that the runtime draws, or its zeros."""
        return torch.from_numpy(self.normals.draw(*shape)) if self.seeded else torch.zeros(shape)

    def history(self):
        """Returns words, observations [1, T, O] and the actions executed in them [1, T, A]; the present one has not happened."""
        happened = [*self.actions, torch.zeros(len(self.low))]
        return [self.words[self.instruction]], torch.stack(self.observations)[None], torch.stack(happened)[None]


class Lads(Whole):
    """LADS, its ablations without a VAE, and Cluster: a code every H steps, an MLP on observation and code."""

    def __init__(self, networks, contract, words):
        super().__init__(networks, contract, words)
        self.codes = networks.codes

    def decide(self):
        self.select(self.networks.high_level(*self.history())[0, -1])

    def action(self):
        return self.networks.low_level(self.observations[-1][None], self.networks.codes[self.plans[-1]][None])[0]


class History(Whole):
    """LADS with a window: a code every H steps; a transformer on the code, the W steps before it and those since."""

    def decide(self):
        *words, observations, actions = self.history()
        known = [actions] if self.contract["family"].get("actions") else []
        self.select(self.networks.high_level(*words, observations, *known)[0, -1])

    def action(self):
        return self.remembering(self.plans[-1])


class Vae(Whole):
    """VAE, and LADS with one: a Gaussian plan every H steps, its mean or a draw."""

    def decide(self):
        mean, log_std = self.networks.high_level(*self.history())[0, -1].chunk(2)
        self.vector = mean + log_std.clamp(*LOG_STD).exp() * self.draw(len(mean))

    def action(self):
        if "history" in self.contract["family"]:
            return self.remembering(self.vector)
        return self.networks.low_level(self.observations[-1][None], self.vector[None])[0]


class LangDt(Whole):
    """Lang DT: the transformer gives the action."""

    def action(self):
        return self.networks.high_level(*self.history())[0, -1]


class Quantised(Whole):
    """Policies whose high level regresses a plan from words and observations, of which the nearest code is taken."""

    def decide(self):
        words, observations, _ = self.history()
        trained = self.trained
        regressed = trained.project_in(trained.high_level(words, observations)[0, -1])
        self.select(weights.nearness(regressed, trained.codebook.codes))

    @property
    def trained(self):
        return self.networks


class Lisa(Quantised):
    """LISA: a transformer over the steps since the decision."""

    def action(self):
        start = (len(self.observations) - 1) // contracts.period(self.contract) * contracts.period(self.contract)
        _, observations, actions = (part if isinstance(part, list) else part[:, start:] for part in self.history())
        low = self.networks.low_level
        options = low.embed_option(self.networks.option_table()[self.plans[-1]]).expand(1, observations.shape[1], -1)
        return low.chunks(options, torch.tensor([start]), observations, actions)[0, -1]


class Denoising(Quantised):
    """Policies whose low level denoises: `networks` holds them as trained, and the acting network that denoises."""

    def __init__(self, networks, contract, words):
        super().__init__(networks, contract, words)
        self.passes = contract["family"]["denoise"]["steps"]

    @property
    def trained(self):
        return self.networks["trained"]

    def read(self, seen):
        self.present = seen  # raw, as its denoiser reads it
        return self.trained.normalizer(seen)


class Lcsd(Denoising):
    """LCSD, our reading: a plan and a denoised action at every step."""

    def action(self):
        noise = self.draw(1 + self.passes, len(self.low))
        return self.networks["acting"].denoise(self.present[None], self.plans[-1], noise)[0]


class SkillDiffuser(Denoising):
    """SkillDiffuser: every H steps observations by denoising, and the actions between them."""

    def decide(self):
        super().decide()
        acting = self.networks["acting"]
        draws = 1 + self.passes if acting.sampler.name == "ddpm" else 1
        shape = acting.denoiser.shape
        self.queue = acting.chunk(self.present[None], self.plans[-1], self.draw(draws * shape.rows * shape.inputs))

    def action(self):
        return self.queue[(len(self.observations) - 1) % contracts.period(self.contract)]


KINDS = {"lads": Lads, "history": History, "vae": Vae, "lang_dt": LangDt, "lisa": Lisa, "lcsd": Lcsd, "skilldiffuser": SkillDiffuser}


def of(model, contract, words, run=None, over=()):
    """Makes the policy of a bundle -> the policy, and where its weights are from.

    `run` is the folder of the training that the bundle was exported from, `over` the files of a system's values that it was exported with.
    """
    kind = contract["family"]["kind"]
    if kind not in KINDS:
        raise UserError(f"a {kind} policy; a reference is made of {', '.join(KINDS)}")
    if run is not None:
        return of_networks(*_trained(model, contract, run, over), contract, words), "the run's checkpoint"
    if kind != "lads":
        raise UserError(f"a {kind} policy, whose layers are folded in the bundle; name the training that it was exported from with --run")
    return Lads(weights.from_bundle(model, contract), contract, words), "the bundle's initializers"


def of_networks(networks, setting, encoded, contract, words):
    """Makes the policy of a system's trained networks."""
    kind = contract["family"]["kind"]
    if kind in ("lads", "history"):
        networks = weights.from_lads(networks, getattr(setting.config.system, "regressed", False))
    elif kind in ("lcsd", "skilldiffuser"):
        networks = nn.ModuleDict({"trained": networks, "acting": systems.of(setting.config).acting(networks, setting, encoded)})
    return KINDS[kind](networks, contract, words)


def _trained(model, contract, run, over):
    saved, setting = training.load_run(run, *over)
    if saved["identity"]["dataset_sha256"] != contract["provenance"]["dataset_sha256"]:
        raise UserError(f"{run} was trained on other data than the bundle")
    encoded = language.encode(setting.config.language, [row["text"] for row in setting.instructions])
    system = systems.of(setting.config)
    networks = system.Networks(setting, encoded)
    training.load_networks(networks, saved["networks"], run)
    networks.eval()
    if not _alike(_weights(system.export(networks, setting, encoded).model), _weights(model)):
        raise UserError(f"{run} is not the run that the bundle was exported from; name that one, and with --system what it was exported with")
    return networks, setting, encoded


def _weights(model):
    """Returns the initializers of a bundle by name, but for the words, which are another network's."""
    return {row.name: numpy_helper.to_array(row) for row in model.graph.initializer if "instruction." not in row.name}


def _alike(ours, theirs):
    """Says whether two bundles have the same weights; an export's last digit may be another on another CPU."""
    same = lambda a, b: a.shape == b.shape and np.allclose(a, b, rtol=1e-5, atol=1e-7)
    return ours.keys() == theirs.keys() and all(same(ours[name], theirs[name]) for name in ours)


def disturbed(policy, relative, generator):
    """Copies a policy with noise on each weight, of a standard deviation relative to it."""
    networks = copy.deepcopy(policy.networks)
    with torch.no_grad():
        for value in networks.state_dict().values():
            if value.is_floating_point():
                value.mul_(1 + relative * torch.randn(value.shape, generator=generator))
    return type(policy)(networks, policy.contract, policy.words)
