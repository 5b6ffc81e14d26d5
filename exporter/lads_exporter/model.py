"""The networks of LADS for state observations (the paper's Section 4 and Appendix B.1).

Shapes: B trajectories, T control steps, L words, O observation, A action, H horizon, M codes, D plan.
All networks take normalised observations; `Normalizer` is applied by whoever feeds them and is folded
into the graphs at export.
"""

import math

import torch
import torch.nn.functional as F
from torch import nn

from .codebook import Codebook


class Normalizer(nn.Module):
    """Normalises observations as (observation - mean) / std, with the statistics of the dataset."""

    def __init__(self, observation_len):
        super().__init__()
        self.register_buffer("mean", torch.zeros(observation_len))
        self.register_buffer("std", torch.ones(observation_len))

    def forward(self, observations):
        return (observations - self.mean) / self.std


class Dropout(nn.Module):
    """Dropout whose rate is rounded to 1/256: one random byte per element, which is several times faster on a CPU."""

    def __init__(self, rate):
        super().__init__()
        self.threshold = round(rate * 256)

    def forward(self, x):
        if not self.training or self.threshold == 0:
            return x
        words = torch.empty((x.numel() + 7) // 8, dtype=torch.int64, device=x.device).random_(-(2**63), None)
        keep = words.view(torch.uint8)[: x.numel()].view(x.shape) >= self.threshold
        return x * keep.to(x.dtype).mul_(256 / (256 - self.threshold))


def attend(q, k, v, mask, step=1):
    """Computes masked attention: q [B, h, R, d], k and v [B, h, S, d], mask [B, 1, R, S] added to the scores.

    In two blocks of queries, each against the keys up to its last row: a quarter of the square is never computed,
    and in bfloat16 on a CPU this takes less than half the time of the fused operator. On a GPU too: there, trainings
    with the fused operator in this place ended with a loss that is not finite.
    Query row R - 1 stands at key S - 1, the row before it at S - 1 - step, and so on.
    """
    rows, keys = q.shape[2], k.shape[2]
    q, mask = q * q.shape[-1] ** -0.5, mask.to(q.dtype)
    size = max(16, -(-rows // 2))
    mixed = []
    for start in range(0, rows, size):
        stop = min(start + size, rows)
        seen = keys - (rows - stop) * step
        scores = q[:, :, start:stop] @ k[:, :, :seen].transpose(-1, -2) + mask[:, :, start:stop, :seen]
        mixed.append(scores.softmax(-1) @ v[:, :, :seen])
    return torch.cat(mixed, 2)


class Block(nn.Module):
    """A pre-norm transformer block."""

    def __init__(self, hidden, heads, dropout):
        super().__init__()
        self.heads = heads
        self.norm1 = nn.LayerNorm(hidden)
        self.qkv = nn.Linear(hidden, 3 * hidden)
        self.out = nn.Linear(hidden, hidden)
        self.norm2 = nn.LayerNorm(hidden)
        self.up = nn.Linear(hidden, 4 * hidden)
        self.down = nn.Linear(4 * hidden, hidden)
        self.drop = Dropout(dropout)

    def forward(self, x, mask, rows=slice(None)):
        """Runs the block: x [B, S, d], mask [B, 1, S, S] -> the outputs of `rows` only, [B, R, d]."""
        batch, tokens, hidden = x.shape
        qkv = self.qkv(self.norm1(x)).view(batch, tokens, 3, self.heads, hidden // self.heads)
        q, k, v = (row.contiguous() for row in qkv.permute(2, 0, 3, 1, 4))
        mixed = attend(q[:, :, rows], k, v, mask[:, :, rows], rows.step or 1)
        x = x[:, rows] + self.drop(self.out(mixed.transpose(1, 2).reshape(batch, -1, hidden)))
        return x + self.drop(self.down(F.relu(self.up(self.norm2(x)))))


def start_weights(transformer):
    """Initialises weights of all linear layers and tables from N(0, 0.02), biases with 0."""
    for module in transformer.modules():
        if isinstance(module, (nn.Linear, nn.Embedding)):
            nn.init.normal_(module.weight, 0.0, 0.02)
        if isinstance(module, nn.Linear):
            nn.init.zeros_(module.bias)


class HighLevelPolicy(nn.Module):
    """High level pi_h: a causal transformer over words, states and actions; plan logits at every state token (equation 8).

    Without an `action_len` the history is of states only, as LISA's.
    """

    def __init__(self, config, word_dim, observation_len, action_len, codes):
        super().__init__()
        hidden = config.hidden
        self.embed_word = nn.Linear(word_dim, hidden)
        self.embed_observation = nn.Linear(observation_len, hidden)
        self.embed_action = nn.Linear(action_len, hidden) if action_len else None
        self.embed_timestep = nn.Embedding(config.context_steps, hidden)
        self.embed_norm = nn.LayerNorm(hidden)
        self.drop = Dropout(config.dropout)
        self.blocks = nn.ModuleList(Block(hidden, config.heads, config.dropout) for _ in range(config.layers))
        self.norm = nn.LayerNorm(hidden)
        self.head = nn.Linear(hidden, codes)
        start_weights(self)

    def forward(self, words, observations, actions=None):
        """Computes the plans' logits: words: B tensors [L_i, E]; observations [B, T, O]; actions [B, T, A], or None -> logits [B, T, M].

        Each sequence is its words, then s_0, a_0, s_1, a_1, ...; shorter instructions are padded at the front
        and the padding is masked, so that state tokens stand in the same rows throughout a batch. Shorter
        trajectories are padded by the caller at the end, which the causal mask hides.
        """
        steps = observations.shape[1]
        time = self.embed_timestep.weight[:steps]
        history = self.embed_observation(observations) + time
        if self.embed_action is not None:
            pairs = torch.stack([history, self.embed_action(actions) + time], 2)
            history = pairs.flatten(1, 2)[:, :-1]  # nothing follows the last action
        prefix = max(len(row) for row in words)
        padded = torch.stack([F.pad(row, (0, 0, prefix - len(row), 0)) for row in words])
        x = torch.cat([self.embed_word(padded), history], 1)
        mask = self._mask([prefix - len(row) for row in words], x.shape[1], x.device)
        x = self.drop(self.embed_norm(x.float()))
        for block in self.blocks[:-1]:
            x = block(x, mask)
        states = self.blocks[-1](x, mask, slice(prefix, None, 1 if self.embed_action is None else 2))
        return self.head(self.norm(states)).float()

    @staticmethod
    def _mask(padding, tokens, device):
        """Makes the mask that is added to the scores: large and negative for later tokens and for the padding before the words."""
        column = torch.arange(tokens, device=device)
        hidden = column > column[:, None]
        if any(padding):
            hidden = hidden | (column < torch.tensor(padding, device=device)[:, None])[:, None, None]
        return torch.where(hidden, -1e4, 0.0).expand(len(padding), 1, -1, -1)


class LowLevelPolicy(nn.Module):
    """Low level pi_l: an MLP from observation and plan to action; batch norm on all layers but the first and the last.

    For states the paper's linear observation encoder and the first layer are one linear map; they are one here.
    """

    def __init__(self, config, observation_len, plan_len, action_len):
        super().__init__()
        hidden = config.hidden
        self.slope = config.slope
        self.first = nn.Linear(observation_len + plan_len, hidden)
        self.middle = nn.ModuleList(nn.Linear(hidden, hidden, bias=False) for _ in range(config.layers - 2))
        self.norms = nn.ModuleList(nn.BatchNorm1d(hidden) for _ in range(config.layers - 2))
        self.last = nn.Linear(hidden, action_len)

    def forward(self, observations, plans):
        """Computes the actions: observations [N, O], plans [N, D] -> actions [N, A]."""
        x = F.leaky_relu(self.first(torch.cat([observations, plans], -1)), self.slope)
        for linear, norm in zip(self.middle, self.norms):
            x = F.leaky_relu(norm(linear(x)), self.slope)
        return self.last(x)


class TrajectoryEncoder(nn.Module):
    """Trajectory encoder q: an LSTM over the encoded (s, a) of a segment, then a 3-layer MLP to the latent (before quantisation).

    It may be shown the first `observed` elements of the observation only, for instance the robot's joints: then
    a plan says how the robot moves, whatever was done before. Or it may be shown the changes since the segment's first
    step: then a plan says what happens, wherever that is.
    """

    def __init__(self, hidden, observation_len, action_len, plan_len, observed, relative):
        super().__init__()
        self.relative = relative
        self.register_buffer("shown", (torch.arange(observation_len) < observed).float(), persistent=False)
        self.embed_observation = nn.Linear(observation_len, hidden)
        self.embed_action = nn.Linear(action_len, hidden)
        self.lstm = nn.LSTM(2 * hidden, hidden, batch_first=True)
        self.mlp = nn.Sequential(
            nn.Linear(hidden, hidden), nn.LeakyReLU(), nn.Linear(hidden, hidden), nn.LeakyReLU(), nn.Linear(hidden, plan_len)
        )

    def input_weights(self):
        """Multiplies the two linear encoders into the LSTM's input weights: weight [4h, O+A], bias [4h]."""
        on_observation, on_action = self.lstm.weight_ih_l0.chunk(2, 1)
        from_observation = on_observation @ (self.embed_observation.weight * self.shown)
        weight = torch.cat([from_observation, on_action @ self.embed_action.weight], 1)
        bias = self.lstm.bias_ih_l0 + on_observation @ self.embed_observation.bias + on_action @ self.embed_action.bias
        return weight, bias

    def forward(self, observations, actions, lengths):
        """Encodes segments: observations [N, H, O], actions [N, H, A], lengths [N] (valid steps, at least 1) -> latents [N, D]."""
        if self.relative:
            observations = observations - observations[:, :1]
        weight, bias = self.input_weights()
        hidden = self.lstm.hidden_size
        start = observations.new_zeros(1, len(observations), hidden)
        weights = [weight, self.lstm.weight_hh_l0, bias, self.lstm.bias_hh_l0]
        joined = torch.cat([observations, actions], -1)
        out = torch._VF.lstm(joined, (start, start), weights, True, 1, 0.0, self.training, False, True)[0]
        return self.mlp(out[torch.arange(len(out), device=out.device), lengths - 1])


class Alignment(nn.Module):
    """Semantic alignment: the projectors phi and psi and the contrastive loss of equations 10, 25 and 26."""

    def __init__(self, config, plan_len, sentence_dim):
        super().__init__()
        hidden = config.hidden
        self.embed = nn.Linear(plan_len, hidden)
        self.position = nn.Parameter(torch.randn(config.segments, hidden) * 0.02)
        layer = nn.TransformerEncoderLayer(hidden, config.heads, 4 * hidden, config.dropout, batch_first=True)
        self.transformer = nn.TransformerEncoder(layer, config.layers, enable_nested_tensor=False)
        self.phi = self._projector(hidden, hidden, config.out)
        self.psi = self._projector(sentence_dim, hidden, config.out)
        self.log_scale = nn.Parameter(torch.tensor(math.log(1 / 0.07)))
        self.segment_dropout = config.segment_dropout

    @staticmethod
    def _projector(inputs, hidden, out):
        return nn.Sequential(
            nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, out)
        )

    def forward(self, plans, valid, sentences, instruction):
        """Computes the contrastive loss: plans [B, S, D], valid [B, S], sentences [B, E], instruction [B] -> loss.

        Trajectories with the same instruction are neither positive nor negative to each other.
        """
        if self.training and self.segment_dropout > 0:
            valid = self.some(valid)
        x = self.embed(plans) + self.position[: plans.shape[1]]
        x = self.transformer(x, src_key_padding_mask=~valid)
        x = (x * valid[..., None]).sum(1) / valid.sum(1, keepdim=True)
        similarity = F.normalize(self.phi(x), dim=-1) @ F.normalize(self.psi(sentences), dim=-1).T
        logits = similarity * self.log_scale.exp().clamp(max=100.0)
        itself = torch.arange(len(plans), device=plans.device)
        same = instruction[:, None] == instruction[None]
        same[itself, itself] = False
        logits = logits.masked_fill(same, -1e9)
        return F.cross_entropy(logits, itself) + F.cross_entropy(logits.T, itself)

    def some(self, valid):
        """Leaves out a random share of each sequence's plans, so that every plan alone has to identify the instruction."""
        draw = torch.rand(valid.shape, device=valid.device).masked_fill(~valid, -1.0)
        last = draw == draw.max(1, keepdim=True).values  # no sequence becomes empty
        return valid & ((draw >= self.segment_dropout) | last)


class Lads(nn.Module):
    """All networks of one policy. `forward` is not defined: the parts are trained and exported separately."""

    def __init__(self, setting, encoded, head=None):
        """Makes the networks; `head` is the number of the high level's outputs, if they are not logits over the codes."""
        super().__init__()
        config, o, a = setting.config, setting.observation_len, setting.action_len
        encoder = config.encoder
        self.normalizer = Normalizer(o)
        self.encoder = TrajectoryEncoder(encoder.hidden, o, a, encoder.codebook_dim, encoder.observed or o, encoder.relative)
        self.codebook = Codebook(encoder)
        self.low_level = LowLevelPolicy(config.low_level, o, encoder.codebook_dim, a)
        self.high_level = HighLevelPolicy(config.high_level, encoded.dim, o, a, head or encoder.codebook_size)
        sentence_dim = len(encoded.instructions[0].sentence)
        self.alignment = Alignment(config.alignment, encoder.codebook_dim, sentence_dim)
