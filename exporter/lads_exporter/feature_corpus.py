"""A corpus whose observations are the joints and a frozen encoder's features of frames: those stay in half precision until they are drawn.

Shapes: E episodes, T control steps, J joints, F features. Every observation is [..., J + F], normalised and clipped as the exported graph
does it.
"""

import numpy as np
import torch

from .corpus import Corpus

CHUNK = 4096  # rows at a time, for sums in double precision


class FeatureCorpus(Corpus):
    def __init__(self, dataset, setting, encoded, device):
        super().__init__(dataset, setting, encoded, device)
        seen = setting.config.pretrained
        self.clip, self.encoder_sees = seen.clip, setting.config.encoder.observed or setting.observation_len
        own = lambda table: None if table is None else table[..., : seen.joints]
        self.joints, self.clean, self.noise = own(self.observations), own(self.states), own(self.noise)
        self.places = self._padded(torch.from_numpy(dataset.frame_rows)[:, None] + 1, dataset)[..., 0] - 1  # -1 beyond an episode's end
        training = np.concatenate([dataset.frame_rows[dataset.rows(e)] for e in self.train.tolist()])
        self.encoder_sha256 = dataset.features.encoder
        self.features = torch.from_numpy(dataset.features.rows).to(device)
        mean, std = statistics(dataset.features.rows, training, seen.std_floor)
        self.seen_mean, self.seen_std = torch.cat([own(self.mean), mean]), torch.cat([own(self.std), std])
        self.mean, self.std = torch.zeros_like(self.seen_mean), torch.ones_like(self.seen_std)  # its rows are normalised
        self.feature_mean, self.feature_std = mean.to(device), std.to(device)
        self.observations = Rows(self)

    def shown(self, episodes, steps):
        """Returns observations at (episode, step), with fresh noise on the joints where the configuration asks for it."""
        joints = self.joints[episodes, steps]
        if self.clean is not None:
            joints = self.clean[episodes, steps] + self.noise * (2 * torch.rand_like(joints) - 1)
        return self.beside(joints, (episodes, steps))

    def beside(self, joints, index):
        """Joins joints with the features of the steps at an index into [E, T]; zeros beyond an episode's end."""
        places = self.places[index]
        features = (self.features[places].float() - self.feature_mean) / self.feature_std * (places >= 0)[..., None]
        return torch.cat([joints, features], -1).clamp(-self.clip, self.clip)

    def windowed(self, at):
        """Returns what the trajectory encoder sees; the low level takes its observations by itself, with the window before them."""
        if self.encoder_sees <= self.joints.shape[-1]:
            return self.joints[at][..., : self.encoder_sees], None
        return self.observations[at][..., : self.encoder_sees], None


class Rows:
    """Observations [E, T, J + F] by index, made when they are asked for."""

    def __init__(self, corpus):
        self.corpus = corpus

    def __getitem__(self, index):
        return self.corpus.beside(self.corpus.joints[index], index)


def statistics(features, rows, floor):
    """Computes mean and std [F] of some rows of features [T, F]; a std is at least `floor` times the median one.

    A feature that hardly moves in training may move later, and would be blown up.
    """
    total, squares = np.zeros(features.shape[1]), np.zeros(features.shape[1])
    for part in np.array_split(rows, max(1, len(rows) // CHUNK)):
        values = features[part].astype(np.float64)
        total += values.sum(0)
        squares += np.square(values).sum(0)
    mean = total / len(rows)
    std = np.sqrt(np.maximum(squares / len(rows) - np.square(mean), 0.0))
    least = floor * np.median(std)
    std = np.maximum(std, least if least > 0 else 1.0)
    return tuple(torch.from_numpy(values.astype(np.float32)) for values in (mean, std))
