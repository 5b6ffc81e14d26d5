"""Loads a dataset as padded tensors on one device, with the samplers that training draws from.

Shapes: E episodes, T the longest episode plus H (so that every window of H steps can be sliced).
Observations are normalised with the statistics of the training episodes.
"""

from dataclasses import dataclass

import numpy as np
import torch

from .config import UserError

POOL = 8  # batches of similar length are cut from a pool of this many


@dataclass(frozen=True)
class Segments:
    """Windows of H steps, N of them; `valid` [N, H] is False beyond a trajectory's end."""

    observations: torch.Tensor  # [N, H, O]
    actions: torch.Tensor  # [N, H, A] the labels
    executed: torch.Tensor  # [N, H, A]
    lengths: torch.Tensor  # [N] valid steps
    rows: torch.Tensor  # [N] row of the batch it belongs to
    starts: torch.Tensor  # [N] the step it starts at
    places: torch.Tensor  # [N] its number in that trajectory
    low_level_observations: torch.Tensor  # [N, H, O] what the low level is shown; see `Corpus.shown`

    @property
    def valid(self):
        horizon = self.observations.shape[1]
        return torch.arange(horizon, device=self.lengths.device) < self.lengths[:, None]


class Corpus:
    def __init__(self, dataset, setting, encoded, device):
        """Loads a dataset; `encoded` are the instructions that its episodes point to."""
        config = setting.config
        self.horizon, self.device = config.encoder.horizon, device
        count = len(dataset)
        held_out = np.zeros(count, bool)
        if config.data.validation_every > 0:
            held_out[config.data.validation_every - 1 :: config.data.validation_every] = True
        self.train, self.validation = (torch.from_numpy(np.flatnonzero(x)) for x in (~held_out, held_out))
        if len(self.validation) == 0 or len(self.train) == 0:
            raise UserError(f"{count} episodes are too few to hold out every {config.data.validation_every}th")
        training_rows = np.concatenate([np.arange(dataset.rows(e).start, dataset.rows(e).stop) for e in self.train])
        seen = dataset.observations[training_rows]
        self.mean = torch.from_numpy(seen.mean(0, dtype=np.float64).astype(np.float32))
        self.std = torch.from_numpy(np.maximum(seen.std(0, dtype=np.float64), config.data.std_floor).astype(np.float32))
        normed = lambda array: (torch.from_numpy(array) - self.mean) / self.std
        self.lengths = torch.from_numpy(dataset.lengths())
        self.steps = int(self.lengths.max()) + self.horizon
        self.observations = self._padded(normed(dataset.observations), dataset)
        mask = np.array(config.data.action_mask or [1] * setting.action_len, np.float32)
        self.actions = self._padded(torch.from_numpy(dataset.actions * mask), dataset)
        self.executed = self._padded(torch.from_numpy(dataset.executed * mask), dataset)
        self.states = self.noise = None
        if config.data.renoise:
            if dataset.states is None:
                raise UserError("data.renoise = true needs noise-free states, which this dataset lacks; set it to false")
            self.states = self._padded(normed(dataset.states), dataset)
            self.noise = (torch.from_numpy(dataset.noise_amplitude()) / self.std).to(device)
        self.instruction = torch.from_numpy(dataset.instruction)
        self.words = [torch.from_numpy(row.words).to(device) for row in encoded.instructions]
        self.sentences = torch.from_numpy(np.stack([row.sentence for row in encoded.instructions])).to(device)
        weights = [config.data.weights.get(row["id"], 1.0) for row in setting.instructions]
        self.own_texts = dataset.texts is not None
        self.weights = torch.ones(count) if self.own_texts else torch.tensor(weights)[self.instruction]
        lengths = self.lengths[self.train]
        self.transition_episodes = self.train.repeat_interleave(lengths)
        self.transition_steps = torch.cat([torch.arange(n) for n in lengths.tolist()])
        self.cumulative = self.weights[self.transition_episodes].double().cumsum(0)

    def _padded(self, rows, dataset):
        out = rows.new_zeros(len(dataset), self.steps, rows.shape[1])
        out[torch.arange(self.steps) < self.lengths[:, None]] = rows
        return out.to(self.device)

    def shown(self, episodes, steps):
        """Returns normalised observations at (episode, step): as recorded, or the clean state with fresh noise."""
        if self.states is None:
            return self.observations[episodes, steps]
        states = self.states[episodes, steps]
        return states + self.noise * (2 * torch.rand_like(states) - 1)

    def windowed(self, at):
        """Returns what the trajectory encoder and the low level see at (episodes, steps)."""
        return self.observations[at], self.shown(*at)

    def draw(self, batch, generator):
        """Draws `batch` training episodes by weight."""
        weights = self.weights[self.train]
        chosen = torch.multinomial(weights, batch, replacement=batch > len(weights), generator=generator)
        return self.train[chosen]

    def draw_alike(self, batch, step, generator_of):
        """Draws `batch` training episodes by weight, of similar length: one of the batches of a pool sorted by length, each used once."""
        pool = self.draw_pool(batch, generator_of(step // POOL))
        order = torch.randperm(POOL, generator=generator_of(-1 - step // POOL))
        return pool[order[step % POOL]]

    def draw_pool(self, batch, generator):
        drawn = torch.cat([self.draw(batch, generator) for _ in range(POOL)])
        return drawn[self.lengths[drawn].argsort(stable=True)].view(POOL, batch)

    def draw_transitions(self, batch, generator):
        """Draws `batch` single steps of the training episodes by weight: episode, step, and the start of a window of H steps that it lies
        in."""
        points = torch.rand(batch, generator=generator, dtype=torch.double) * self.cumulative[-1]
        drawn = torch.searchsorted(self.cumulative, points).clamp(max=len(self.transition_steps) - 1)
        episodes, steps = self.transition_episodes[drawn], self.transition_steps[drawn]
        starts = (steps - torch.randint(self.horizon, (batch,), generator=generator)).clamp(min=0)
        return tuple(x.to(self.device) for x in (episodes, steps, starts))

    def segments(self, episodes, offsets, seen=None):
        """Cuts each episode into windows of H steps that start at its offset; the last one may be shorter.

        seen [B, T, O]: observations in place of the corpus' own, a row for each of the episodes.
        """
        rows, starts, places = [], [], []
        for row, (length, offset) in enumerate(zip(self.lengths[episodes].tolist(), offsets.tolist())):
            begin = torch.arange(min(offset, length - 1), length, self.horizon)
            rows.append(torch.full_like(begin, row))
            starts.append(begin)
            places.append(torch.arange(len(begin)))
        rows, starts, places = torch.cat(rows), torch.cat(starts), torch.cat(places)
        return self._windows(episodes[rows], starts, rows, places, seen)

    def _windows(self, episodes, starts, rows, places, seen=None):
        steps = (starts[:, None] + torch.arange(self.horizon)).to(self.device)
        lengths = (self.lengths[episodes] - starts).clamp(max=self.horizon).to(self.device)
        at = episodes.to(self.device)[:, None], steps
        actions, executed, rows = self.actions[at], self.executed[at], rows.to(self.device)
        own, shown = self.windowed(at) if seen is None else 2 * (seen[rows[:, None], steps],)
        return Segments(own, actions, executed, lengths, rows, steps[:, 0], places.to(self.device), shown)

    def every_window(self, episodes):
        """Yields the windows that start at each step of the episodes, one episode after the other."""
        lengths = self.lengths[episodes]
        rows = torch.arange(len(episodes)).repeat_interleave(lengths)
        starts = torch.cat([torch.arange(length) for length in lengths.tolist()])
        return self._windows(episodes[rows], starts, rows, starts)

    def codes(self, encode, episodes):
        """Computes the code of the window that starts at each step of the episodes, [B, T], -1 beyond an episode's end."""
        return self.of_windows(encode, episodes, torch.full((len(episodes), self.steps), -1, dtype=torch.long))

    @torch.no_grad()
    def of_windows(self, encode, episodes, out):
        """Fills `out` [B, T, ...] with what `encode` gives for the window that starts at each step of the episodes."""
        out = out.to(self.device)
        for first, part in enumerate(torch.as_tensor(episodes).split(64)):
            windows = self.every_window(part)
            out[64 * first + windows.rows, windows.starts] = encode(windows)
        return out
