"""Runs the policy in PyTorch, eagerly, from the weights inside a bundle, as a user would who exports nothing.

The transformer keeps its keys and values in tensors that are allocated once and written in place.
"""

import numpy as np
import onnx
import torch
import torch.nn.functional as F
from onnx import numpy_helper


class Eager:
    """All entries that a control loop needs, in PyTorch. One thread, no gradients."""

    def __init__(self, model, contract):
        torch.set_num_threads(1)
        arrays = {t.name.removeprefix("weights/"): numpy_helper.to_array(t).copy() for t in model.graph.initializer}
        self.weights = {name: torch.from_numpy(a) for name, a in arrays.items() if a.dtype == np.float32}
        self.lengths = arrays["constants/instruction.lengths"]
        self.network, self.horizon = contract["network"], contract["family"]["horizon"]
        self.layers, self.heads, self.head_dim = (self.network[k] for k in ("layers", "heads", "head_dim"))
        # The other matrices are stored as [k, n], those of Gemm as [n, k], which is what F.linear wants.
        self.turned = {n: w.T.contiguous() for n, w in self.weights.items() if n.startswith("high_level.") and w.dim() == 2}
        capacity = contract["context"]["words"] + 2 * contract["context"]["steps"]
        shape = (self.layers, 1, self.heads, capacity, self.head_dim)
        self.keys, self.values, self.past = torch.zeros(shape), torch.zeros(shape), 0
        self.masks = {}
        self.slope = next(a.f for n in model.graph.node if n.op_type == "LeakyRelu" for a in n.attribute if a.name == "alpha")
        self.low_layers = sum(n.startswith("low_level.layer.") and n.endswith(".weight") for n in self.weights)

    def linear(self, x, name):
        return F.linear(x, self.turned[name + ".weight"], self.weights[name + ".bias"])

    def gemm(self, x, name):
        return F.linear(x, self.weights[name + ".weight"], self.weights[name + ".bias"])

    def norm(self, x, name):
        scale, bias = self.weights[name + ".scale"], self.weights[name + ".bias"]
        return F.layer_norm(x, scale.shape, scale, bias, 1e-5)

    def mask(self, new, past):
        """Returns the attention mask: a token sees the whole past and, of the new tokens, those up to itself."""
        if new == 1:
            return None
        if new not in self.masks:
            self.masks[new] = torch.triu(torch.full((new, new), float("-inf")), 1)
        return F.pad(self.masks[new], (past, 0))

    def attend(self, x, number, cached):
        name, new = f"high_level.block.{number}", x.shape[1]
        heads = lambda t: t.view(1, new, self.heads, self.head_dim).transpose(1, 2)
        q, k, v = map(heads, self.linear(self.norm(x, name + ".norm1"), name + ".qkv").chunk(3, -1))
        past = 0
        if cached:
            past, end = self.past, self.past + new
            self.keys[number, :, :, past:end], self.values[number, :, :, past:end] = k, v
            k, v = self.keys[number, :, :, :end], self.values[number, :, :, :end]
        mixed = F.scaled_dot_product_attention(q, k, v, attn_mask=self.mask(new, past))
        return self.linear(mixed.transpose(1, 2).reshape(1, new, -1), name + ".out")

    def transformer(self, tokens, cached=True):
        """Runs the transformer: tokens [1, n, d] before the first layer norm -> [1, n, d]."""
        x = self.norm(tokens, "high_level.embed_norm")
        for number in range(self.layers):
            name = f"high_level.block.{number}"
            x = x + self.attend(x, number, cached)
            x = x + self.linear(F.relu(self.linear(self.norm(x, name + ".norm2"), name + ".up")), name + ".down")
        if cached:
            self.past += tokens.shape[1]
        return x

    def logits(self, x):
        """Computes the logits [M] of the last token of x [1, n, d]."""
        return self.gemm(self.norm(x[:, -1], "high_level.norm"), "high_level.head")[0]

    def embed(self, x, name, time):
        """Embeds x [n, k] at positions `time` [n] -> [n, d]."""
        return self.gemm(x, f"high_level.embed_{name}") + self.weights["high_level.embed_timestep"][time]

    def observed(self, observation):
        return observation - self.weights["observation_mean"]

    def words(self, instruction):
        return self.weights["instruction.words"][instruction, : self.lengths[instruction]]

    def instruct(self, words):
        """Starts a new context with words [L, E]."""
        self.past = 0
        self.transformer(self.linear(words, "high_level.embed_word")[None])

    def step(self, observation, action, time):
        """Appends (a_{t-1}, s_t), or s_0 without an action -> logits [M]."""
        tokens = [self.embed(self.observed(observation)[None], "observation", [time])]
        if action is not None:
            tokens.insert(0, self.embed(action[None], "action", [time - 1]))
        return self.logits(self.transformer(torch.cat(tokens)[None]))

    def recompute(self, words, observations, actions):
        """Computes the logits after words [L, E], observations [T, O] and actions [T - 1, A], from nothing."""
        steps = len(observations)
        seen = self.embed(self.observed(observations), "observation", torch.arange(steps))
        done = self.embed(actions, "action", torch.arange(steps - 1))
        pairs = torch.stack([done, seen[1:]], 1).flatten(0, 1)
        tokens = torch.cat([self.linear(words, "high_level.embed_word"), seen[:1], pairs])
        return self.logits(self.transformer(tokens[None], cached=False))

    def plan(self, index):
        return self.weights["codebook"][index]

    def act(self, observation, plan):
        x = torch.cat([self.observed(observation), plan])[None]
        for number in range(self.low_layers):
            x = self.gemm(x, f"low_level.layer.{number}")
            if number < self.low_layers - 1:
                x = F.leaky_relu(x, self.slope)
        return x[0]
