"""Training inputs of the transformers over whole histories: word embeddings, and trajectories cut where the controller restarts.

A *mark* stands at every control step of an episode: at least 0 where there is something to learn and -1 where there is not. Systems
give what they like as marks (codes, or places of targets) and get them back in the rows of the cut contexts.
"""

import torch
import torch.nn.functional as F

from .endings import Endings


class Contexts:
    """Episodes of a corpus as the inputs of a high level."""

    def __init__(self, corpus, setting):
        self.corpus, self.config = corpus, setting.config
        self.endings = Endings(setting, corpus.device)

    def take(self, episodes, marks, training):
        """Cuts the episodes: marks [B, T] -> words (R tensors), marks [R, T'], observations [R, T', O], executed [R, T', A]; R contexts of
        at most `context_steps`."""
        corpus = self.corpus
        length = int(corpus.lengths[episodes].max())
        at = episodes.to(corpus.device)
        words, marks = self.instructions(episodes, marks[:, :length], training)
        observations, executed = corpus.observations[at, :length], corpus.executed[at, :length]
        return self._cut(words, marks, observations, executed)

    def places(self, episodes, rows=None):
        """Makes marks that name each step: row * T + step, [B, T]; -1 beyond an episode's end. A row is the episode itself, or what `rows`
        says."""
        steps = torch.arange(self.corpus.steps)
        named = (episodes if rows is None else rows)[:, None] * self.corpus.steps + steps
        return torch.where(steps < self.corpus.lengths[episodes][:, None], named, -1).to(self.corpus.device)

    def _cut(self, words, marks, observations, executed):
        """Cuts trajectories that are longer than the context where the controller restarts it: a row for each context."""
        most, length = self.config.high_level.context_steps, marks.shape[1]
        if length <= most:
            return words, marks, observations, executed
        count = -(-length // most)
        more = count * most - length
        marks = F.pad(marks, (0, more), value=-1).reshape(-1, most)
        observations, executed = (F.pad(x, (0, 0, 0, more)).reshape(-1, most, x.shape[-1]) for x in (observations, executed))
        kept = (marks >= 0).any(1)
        words = [words[row // count] for row in kept.nonzero()[:, 0].tolist()]
        return words, marks[kept], observations[kept], executed[kept]

    def instructions(self, episodes, marks, training):
        """Returns the words of each episode's instruction and its marks; in training, some with another ending."""
        words = [self.corpus.words[i] for i in self.corpus.instruction[episodes]]
        if not training:
            return words, marks
        if self.corpus.own_texts:  # labels of what was done have no order, so no ending
            return [self.some_words(row) for row in words], marks
        marks = marks.clone()
        for row, episode in enumerate(episodes.tolist()):
            other = self.endings.draw(int(self.corpus.instruction[episode]), int(self.corpus.lengths[episode]))
            if other is not None:
                words[row], steps = other
                marks[row, steps:] = -1
        return [self.some_words(row) for row in words], marks

    def some_words(self, words):
        """Disturbs the words and leaves out a random few; the last token ([SEP]) always stays."""
        rate, noise = self.config.data.word_dropout, self.config.data.word_noise
        if noise > 0:
            words = words + noise * words.square().mean().sqrt() * torch.randn_like(words)
        if rate == 0:
            return words
        keep = torch.rand(len(words), device=words.device) >= rate
        keep[-1] = True
        return words[keep]
