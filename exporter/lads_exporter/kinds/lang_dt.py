"""Kind `lang_dt`: the high level's transformer whose head is the action, at every step; no plan and no low level."""

from torch import nn

from .. import graphs
from ..model import Normalizer
from . import common


class LangDt(nn.Module):
    """Policy from words, observations and actions to actions."""

    def __init__(self, sizes):
        super().__init__()
        self.normalizer = Normalizer(sizes.observation)
        self.high_level = common.high_level(sizes, sizes.action)

    def forward(self, words, observations, actions):
        """Computes the actions: words [L, E], observations [T, O] in raw units, actions [T, A] as executed -> actions [T, A]."""
        return self.high_level([words], self.normalizer(observations)[None], actions[None])[0]


def build(policy, sizes):
    graph = common.graph_of(policy, sizes)
    for first in (True, False):
        graphs.high_level_step(graph, policy.high_level, policy.normalizer, first, "action", "previous_action")
    return graph.model("lang_dt")


def contract(sizes, seed):
    return common.contract({"kind": "lang_dt"}, sizes, seed)
