"""System `skilldiffuser`: LISA's high level with chunks of H states; a diffusion of H embedded observations and inverse dynamics give H - 1
actions.

Two stages: `joint` trains LISA, whose low level is then left out; `diffusion` freezes the rest and trains U-Net and inverse dynamics on all windows of H
real steps under the option of the chunk that a window starts in. The observations' embedding is the high level's, normalised. The first row is the
present observation and carries no noise, in training as when it acts; the option is left out of a share of the windows for guidance.
Loss: half the squared error of the noise, half that of the actions between true embeddings. Departures from the published code, which at
evaluation conditions on the option divided by H, clips to 1 what has variance 1, and trains with noise in the first row: none of these.
Its configurations take the gradient of all of an option's copies (`option_gradient`), where LISA's take that of the first.
"""

import copy

import torch
import torch.nn.functional as F

from ..kinds import skilldiffuser, unet
from ..kinds.denoising import alpha_bar
from . import base, lisa
from .averaging import follow
from .base import Exported


def shape(setting):
    """Returns the U-Net's sizes."""
    config, system = setting.config, setting.config.system
    return unet.Shape(config.high_level.hidden, system.width, tuple(system.multiples), system.groups, config.encoder.horizon, system.schedule)


class Networks(lisa.Networks):
    def __init__(self, setting, encoded):
        super().__init__(setting, encoded)
        hidden = setting.config.high_level.hidden
        self.denoiser = unet.Unet(shape(setting))
        self.average = copy.deepcopy(self.denoiser).requires_grad_(False)
        self.inverse = skilldiffuser.InverseDynamics(hidden, setting.config.system.inverse, setting.action_len)

    def embedded(self, observations):
        """Embeds normalised observations [..., O] -> the rows that are denoised [..., d]."""
        rows = self.high_level.embed_observation(observations)
        return F.layer_norm(rows, rows.shape[-1:])


class Training(lisa.Training):
    STAGES = {"joint": ("joint", "diffusion"), "staged": ("joint", "diffusion")}

    def __init__(self, networks, corpus, setting, seed_of):
        super().__init__(networks, corpus, setting, seed_of)
        self.bar = torch.from_numpy(alpha_bar(setting.config.system.schedule)).float().to(corpus.device)

    def parts(self, stage):
        return self.PARTS if stage == "joint" else ("denoiser", "inverse")

    def begin(self, stage):
        if stage == "diffusion":
            self.networks.eval()
            self.options = self._options()
            self.windows = self._windows(self.corpus.train)
            self.held_out_windows = self._windows(self.held_out())

    @torch.no_grad()
    def _options(self):
        """Returns the code in force at each step of every episode, [E * T]: that of the chunk it lies in."""
        codes = torch.zeros(self.corpus.observations.shape[:2], dtype=torch.long, device=self.corpus.device).flatten()
        for episodes in torch.arange(len(self.corpus.lengths)).split(256):
            latents, chunks = self.latents(episodes, self.corpus.horizon)
            index = self.networks.codebook(latents)[1]
            valid = chunks.places >= 0
            codes[chunks.places[valid]] = index[:, None].expand_as(chunks.places)[valid]
        return codes

    def _windows(self, episodes):
        """Returns the place of the first step of every window of H real steps."""
        lengths = self.corpus.lengths[episodes]
        starts = torch.arange(self.corpus.steps)
        fits = starts[None] + self.corpus.horizon <= lengths[:, None]
        return (episodes[:, None] * self.corpus.steps + starts)[fits].to(self.corpus.device)

    def diffusion(self, places, levels=None):
        """Computes the losses of the windows that start at `places` [N]."""
        networks, config = self.networks, self.config.system
        steps = places[:, None] + torch.arange(self.corpus.horizon, device=places.device)
        with torch.no_grad():
            rows = networks.embedded(self.corpus.observations.flatten(0, 1)[steps])
            options = networks.option_table()[self.options[places]]
        training = networks.denoiser.training
        levels = torch.randint(1, len(self.bar), (len(places),), device=places.device) if levels is None else levels
        share = self.bar[levels][:, None, None]
        eps = torch.randn_like(rows)
        noisy = torch.cat([rows[:, :1], (share.sqrt() * rows + (1 - share).sqrt() * eps)[:, 1:]], 1)
        known = (torch.rand(len(places), 1, device=places.device) >= (config.dropout if training else 0.0)).float()
        denoiser = networks.denoiser if training else networks.average
        predicted = denoiser(noisy, denoiser.told(levels, options, known))
        actions = networks.inverse(rows)
        targets = self.corpus.actions.flatten(0, 1)[steps[:, :-1]]
        return {"noise": F.mse_loss(predicted[:, 1:], eps[:, 1:]), "bc": F.mse_loss(actions, targets)}

    def loss(self, stage, step):
        if stage == "joint":
            return super().loss(stage, step)
        batch = self.settings(self.config, stage).batch
        drawn = torch.randint(len(self.windows), (batch,), generator=self.generator(stage, step))
        parts = self.diffusion(self.windows[drawn.to(self.windows.device)])
        return 0.5 * (parts["noise"] + parts["bc"]), parts

    def after(self, stage):
        if stage == "diffusion":
            follow(self.networks.average, self.networks.denoiser, self.config.system.average)

    def finish(self, stage):
        """Applies no gain: what is denoised is not a mean."""

    @torch.no_grad()
    def validate(self, stage):
        if stage == "joint":
            return super().validate(stage)
        self.networks.eval()
        parts = self.diffusion(self.held_out_windows[: 4 * base.HELD_OUT])
        return {"val_bc": float(parts["bc"]), "val_noise": float(parts["noise"])}


def sampler(setting):
    system = setting.config.system
    return skilldiffuser.Sampler(system.sampler, system.schedule, system.passes, system.guidance, system.temperature, system.clip)


@torch.no_grad()
def acting(networks, setting, encoded):
    """Returns the policy that acts."""
    policy = skilldiffuser.SkillDiffuser(base.sizes(setting, encoded), shape(setting), setting.config.system.inverse, sampler(setting))
    policy.normalizer.load_state_dict(networks.normalizer.state_dict())
    policy.high_level = networks.folded()
    policy.embed.load_state_dict(networks.high_level.embed_observation.state_dict())
    policy.options.copy_(networks.option_table())
    policy.denoiser.load_state_dict(networks.average.state_dict())
    policy.inverse.load_state_dict(networks.inverse.state_dict())
    return policy.eval()


def export(networks, setting, encoded):
    sizes, policy = base.sizes(setting, encoded), acting(networks, setting, encoded)
    unet_shape = shape(setting)
    family = skilldiffuser.family(sizes, base.decision(setting), unet_shape, policy.sampler, 0)
    return Exported(skilldiffuser.build(policy, sizes), family, noise=[unet_shape.rows * unet_shape.inputs])
