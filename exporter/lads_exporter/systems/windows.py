"""What systems have in common whose low level remembers a window of steps before its plan (`kinds.history`)."""

import torch
import torch.nn.functional as F


class Windows:
    """Put before a system's training among the bases of a class."""

    def in_windows(self, episodes, starts, plans):
        """Computes the mean squared error of the actions of whole plans: episodes [N], starts [N], plans [N, D] as the low level embeds them
        (equation 5)."""
        corpus, low_level = self.corpus, self.networks.low_level
        episodes, starts = (x.to(corpus.device)[:, None] for x in (episodes, starts))
        before = starts.clamp(max=low_level.window)
        # The window's rows begin at its first valid one, as the runtime has them; those behind its last are hidden.
        window = starts - before + torch.arange(low_level.window, device=corpus.device)
        steps = torch.cat([window, starts + torch.arange(corpus.horizon, device=corpus.device)], 1)
        previous = corpus.executed[episodes, (steps - 1).clamp(min=0)] * (steps > 0)[..., None]
        with self.half():
            options = low_level.embed_option(plans)
            actions = low_level.chunks(options, corpus.shown(episodes, steps), previous, before[:, 0])
        own = steps[:, low_level.window :]
        valid = own < corpus.lengths.to(corpus.device)[episodes]
        return F.mse_loss(actions[valid], corpus.actions[episodes, own][valid])
