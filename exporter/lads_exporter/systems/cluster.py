"""System `cluster`: the plans are goals, observations in the middle of clusters of all observations; no latent space is learned.

Observations, z-scored, are laid out in the plane by t-SNE and grouped there by k-means; a cluster's goal is the observation nearest to its centre.
The low level learns to reach the last observation of its own segment, the high level to name the goal nearest to it. So there are two stages. A goal is
nearest by Euclidean distance of z-scored observations, since the plane has no place for new ones.
"""

import torch
import torch.nn.functional as F
from torch import nn

from .. import graphs
from ..codebook import nearest, perplexity
from ..config import UserError
from ..model import HighLevelPolicy, LowLevelPolicy, Normalizer
from . import base, lads
from .base import Exported


class Goals(nn.Module):
    """Goal observations [M, O], z-scored."""

    def __init__(self, count, observation_len):
        super().__init__()
        self.register_buffer("codes", torch.zeros(count, observation_len))
        self.register_buffer("started", torch.tensor(False))


class Networks(nn.Module):
    def __init__(self, setting, encoded):
        super().__init__()
        config, o, a = setting.config, setting.observation_len, setting.action_len
        count = config.encoder.codebook_size
        self.normalizer = Normalizer(o)
        self.codebook = Goals(count, o)
        self.low_level = LowLevelPolicy(config.low_level, o, o, a)
        self.high_level = HighLevelPolicy(config.high_level, encoded.dim, o, a, count)


def medoids(points, count, perplexity, seed):
    """Finds the rows of points [N, O] nearest to the centres of `count` clusters in their t-SNE plane: indices [count]."""
    try:
        from sklearn.cluster import KMeans
        from sklearn.manifold import TSNE
    except ImportError as error:
        raise UserError("Cluster lays observations out by scikit-learn's t-SNE: pip install -e 'exporter[tables]'") from error
    plane = torch.from_numpy(TSNE(2, perplexity=perplexity, init="pca", random_state=seed, n_jobs=1).fit_transform(points.numpy()))
    centres = torch.from_numpy(KMeans(count, init="k-means++", n_init=4, random_state=seed).fit(plane.numpy()).cluster_centers_)
    return torch.cdist(centres.float(), plane.float()).argmin(1)


class Training(base.Training):
    STAGES = {"joint": ("low_level", "high_level"), "staged": ("low_level", "high_level")}

    def parts(self, stage):
        return (stage,)

    def begin(self, stage):
        if not self.networks.codebook.started:
            self._find_goals()
        if stage == "high_level":
            every = torch.arange(len(self.corpus.lengths))
            steps = torch.arange(self.corpus.steps)
            self.codes = self._nearest(self._ends(every[:, None], steps.expand(len(every), -1)))
            self.codes[(steps >= self.corpus.lengths[:, None]).to(self.codes.device)] = -1
            if self.config.training.ce_at == "decisions":
                self.codes[:, steps % self.corpus.horizon > 0] = -1

    def _find_goals(self):
        corpus, config = self.corpus, self.config
        seed = self.seed_of("", "goals", 0)
        generator = torch.Generator().manual_seed(seed)
        chosen = torch.randperm(len(corpus.transition_steps), generator=generator)[: config.system.points]
        points = corpus.observations[corpus.transition_episodes[chosen], corpus.transition_steps[chosen]].cpu()
        goals = points[medoids(points, config.encoder.codebook_size, config.system.perplexity, seed)]
        self.networks.codebook.codes.copy_(goals)
        self.networks.codebook.started.fill_(True)

    def _ends(self, episodes, starts):
        """Returns the last observation of the segments that start at the given steps."""
        last = torch.minimum(starts + self.corpus.horizon - 1, self.corpus.lengths.to(starts.device)[episodes] - 1)
        return self.corpus.observations[episodes.to(self.corpus.device), last.clamp(min=0).to(self.corpus.device)]

    def _nearest(self, observations):
        rows = [nearest(part, self.networks.codebook.codes) for part in observations.flatten(0, -2).split(1 << 16)]
        return torch.cat(rows).view(observations.shape[:-1])

    def loss(self, stage, step):
        if stage == "low_level":
            episodes, steps, starts = self.corpus.draw_transitions(self.settings(self.config, stage).batch, self.generator(stage, step))
            actions = self.networks.low_level(self.corpus.shown(episodes, steps), self._ends(episodes, starts))
            bc = F.mse_loss(actions, self.corpus.actions[episodes, steps])
            return self.config.training.bc_weight * bc, {"bc": bc}
        episodes = self.draw_alike(stage, step)
        ce, _ = self.high_level(episodes, self.codes[episodes.to(self.corpus.device)])
        return ce, {"ce": ce}

    def high_level(self, episodes, codes):
        """Computes the cross-entropy of the goals and the accuracy; codes [B, T], -1 where there is none."""
        high_level = self.networks.high_level
        words, codes, observations, executed = self.contexts.take(episodes, codes, high_level.training)
        with self.half():
            out = high_level(words, observations, executed)
        out, targets = out[codes >= 0], codes[codes >= 0]
        return F.cross_entropy(out, targets), (out.argmax(-1) == targets).float().mean()

    def _uses(self):
        """Counts how often each goal is the nearest at the end of a segment, [M]."""
        starts = self.codes[:, :: self.corpus.horizon]
        return torch.bincount(starts[starts >= 0], minlength=len(self.networks.codebook.codes)).clamp(min=1).float()

    @torch.no_grad()
    def finish(self, stage):
        """Applies the same corrections as LADS after a stage."""
        if stage == "high_level":
            uses = self._uses()
            self.networks.high_level.head.bias.sub_(self.config.high_level.balance * (uses / uses.sum()).log())
        else:
            base.gain(self.networks.low_level.last, self.config.low_level.gain)

    @torch.no_grad()
    def validate(self, stage):
        """Validates with each segment's own end as its goal; segments from step 0."""
        episodes = self.corpus.validation
        self.networks.eval()
        segments = self.corpus.segments(episodes, torch.zeros(len(episodes), dtype=torch.long))
        goals = segments.observations[torch.arange(len(segments.lengths)), segments.lengths - 1]
        valid = segments.valid
        each = goals[:, None].expand(-1, self.corpus.horizon, -1)[valid]
        out = {"val_bc": float(F.mse_loss(self.networks.low_level(segments.low_level_observations[valid], each), segments.actions[valid]))}
        if stage == "high_level":
            ce, accuracy = self.high_level(episodes, self.codes[episodes.to(self.corpus.device)])
            out |= {"val_ce": float(ce), "val_accuracy": float(accuracy)}
        return out

    def summary(self):
        starts = self.codes[:, :: self.corpus.horizon]
        count = len(self.networks.codebook.codes)
        return {"perplexity": perplexity(starts[starts >= 0], count), "codebook_size": count, "revived": 0}


def goal_encode(graph, codes, normalizer, horizon, action_len):
    """Adds the entry that maps a segment to the goal nearest to its last observation."""
    entry = graphs.Entry(graph, "trajectory_encoder/encode")
    observations = entry.input("observations", [1, horizon, len(normalizer.mean)])
    entry.op("Identity", [entry.input("actions", [1, horizon, action_len])], "not_looked_at")
    last = entry.op("Gather", [observations, entry.integers("encoder.last", [horizon - 1])], "last", axis=1)
    flat = entry.op("Reshape", [last, entry.integers("encoder.flat", [1, len(normalizer.mean)])], "last_flat")
    centred = entry.centred(flat, normalizer, "last_centred")
    scaled = entry.op("Mul", [centred, entry.weight("encoder.scale", 1 / normalizer.std.double())], "latent")
    entry.output("latent", [1, len(normalizer.mean)])
    graphs.nearest_code(entry, scaled, codes)


def export(networks, setting, encoded):
    horizon = setting.config.encoder.horizon
    graph = graphs.Graph()
    codes = graphs.to_numpy(networks.codebook.codes)
    graphs.known_instructions(graph, networks.high_level, encoded)
    for first in (True, False):
        graphs.high_level_step(graph, networks.high_level, networks.normalizer, first)
    graphs.codebook_lookup(graph, codes)
    graphs.low_level_act(graph, networks.low_level, networks.normalizer)
    goal_encode(graph, codes, networks.normalizer, horizon, setting.action_len)
    family = lads.family(setting) | {"codebook": {"size": len(codes), "dim": codes.shape[1]}}
    return Exported(graph.model("cluster"), family, segment=horizon)
