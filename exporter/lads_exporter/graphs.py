"""The entry graphs of a bundle, written node by node from the trained networks.

Invariants: every value of an entry is named `entry/...`; initializers are shared between entries, under
`weights/` and `constants/`, and none is stored twice; all shapes are static except the number P of keys and
values that an entry is given. Normalisation is inside: observations come in raw units.
"""

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from .contract import OBSERVATION

OPSET = 18
IR_VERSION = 8
LAYER_NORM_EPSILON = 1e-5


class Graph:
    """Collects the nodes, inputs, outputs and shared initializers of all entries."""

    def __init__(self):
        self.nodes, self.inputs, self.outputs = [], [], []
        self.initializers = {}
        self.observed = OBSERVATION  # what the levels read: the channel, or the features that an encoder's entry hands to them

    def constant(self, name, array):
        """Adds an initializer once and returns its name."""
        array = np.asarray(array, order="C")
        if name in self.initializers:
            assert np.array_equal(self.initializers[name], array), name
        self.initializers[name] = array
        return name

    def model(self, name):
        tensors = [numpy_helper.from_array(array, key) for key, array in self.initializers.items()]
        graph = helper.make_graph(self.nodes, name, self.inputs, self.outputs, tensors)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
        model.producer_name = "lads-exporter"
        return model


class Entry:
    """Adds one entry to a graph. Names passed in are local; names returned are the prefixed ones."""

    def __init__(self, graph, name):
        self.graph, self.name = graph, name

    def input(self, name, shape, kind=TensorProto.FLOAT):
        full = f"{self.name}/{name}"
        self.graph.inputs.append(helper.make_tensor_value_info(full, kind, shape))
        return full

    def output(self, name, shape, kind=TensorProto.FLOAT):
        self.graph.outputs.append(helper.make_tensor_value_info(f"{self.name}/{name}", kind, shape))

    def op(self, kind, inputs, out, **attributes):
        """Adds one node; `out` is a local name, or a list of them."""
        outs = [f"{self.name}/{name}" for name in ([out] if isinstance(out, str) else out)]
        label = outs[0] + ":" + kind
        self.graph.nodes.append(helper.make_node(kind, inputs, outs, name=label, **attributes))
        return outs[0] if isinstance(out, str) else outs

    def weight(self, name, tensor):
        return self.graph.constant(f"weights/{name}", to_numpy(tensor))

    def integers(self, name, values):
        return self.graph.constant(f"constants/{name}", np.array(values, np.int64))

    def scalar(self, name, value):
        return self.graph.constant(f"constants/{name}", np.float32(value))

    def gemm(self, x, weight, bias, out):
        """Multiplies x [m, k] by weight [n, k] (as PyTorch stores it) transposed, plus bias."""
        return self.op("Gemm", [x, weight, bias], out, transB=1)

    def linear(self, x, name, module, out):
        """Computes y = xW + b for x of any rank; the weight is stored [k, n]."""
        product = self.op("MatMul", [x, self.weight(name + ".weight", module.weight.T)], out + ".product")
        return self.op("Add", [product, self.weight(name + ".bias", module.bias)], out)

    def layer_norm(self, x, name, module, out):
        scale, bias = self.weight(name + ".scale", module.weight), self.weight(name + ".bias", module.bias)
        return self.op("LayerNormalization", [x, scale, bias], out, axis=-1, epsilon=LAYER_NORM_EPSILON)

    def centred(self, observation, normalizer, out):
        """Subtracts the mean from the observation; the division by std is folded into the weights that follow."""
        return self.op("Sub", [observation, self.weight("observation_mean", normalizer.mean)], out)


def to_numpy(tensor):
    array = tensor.detach().cpu().numpy() if hasattr(tensor, "detach") else np.asarray(tensor)
    return array.astype(np.float32)


def double(tensor):
    return tensor.detach().cpu().double().numpy()


def fold_std(weight, normalizer):
    """Folds the standard deviation into weights: weight [n, O + rest] on normalised observations -> the same map on centred ones."""
    folded = double(weight)
    observations = len(normalizer.std)
    folded[:, :observations] /= double(normalizer.std)
    return folded


def instruction_lookup(graph, words, lengths):
    """Adds the instruction table: words [I, L, E] zero padded, lengths [I]."""
    entry = Entry(graph, "instruction/lookup")
    index = entry.input("id", [1], TensorProto.INT64)
    entry.op("Gather", [entry.weight("instruction.words", words), index], "words", axis=0)
    entry.op("Gather", [entry.integers("instruction.lengths", lengths), index], "length", axis=0)
    entry.output("words", [1, *words.shape[1:]])
    entry.output("length", [1], TensorProto.INT64)


class Transformer:
    """Nodes of a level's transformer over `new` tokens, with or without a cache of past keys and values."""

    def __init__(self, entry, policy, new, cached, level="high_level"):
        self.entry, self.policy, self.new, self.cached, self.level = entry, policy, new, cached, level
        self.hidden = policy.norm.normalized_shape[0]
        self.heads = policy.blocks[0].heads
        self.head_dim = self.hidden // self.heads
        prefix = "constants/"
        self.split_heads = entry.integers(f"split_heads.{new}", [1, new, self.heads, self.head_dim])
        self.join_heads = entry.integers(f"join_heads.{new}", [1, new, self.hidden])
        self.scale = entry.graph.constant(prefix + "attention_scale", np.float32(self.head_dim**-0.5))
        causal = np.triu(np.full((new, new), -1e9, np.float32), 1)
        self.mask = entry.graph.constant(f"{prefix}causal_mask.{new}", causal)

    def block(self, x, number, record_only=False):
        """Adds block `number`; returns its output rows, or None when only keys and values are wanted."""
        entry, block, name = self.entry, self.policy.blocks[number], f"block.{number}"
        weights = f"{self.level}.block.{number}"
        normed = entry.layer_norm(x, weights + ".norm1", block.norm1, name + ".norm1")
        joint = entry.linear(normed, weights + ".qkv", block.qkv, name + ".qkv")
        q, k, v = entry.op("Split", [joint], [f"{name}.{t}_rows" for t in "qkv"], axis=-1, num_outputs=3)
        wanted = {"key": k, "value": v} if record_only else {"query": q, "key": k, "value": v}
        heads = {t: self._to_heads(rows, f"{name}.{t}", number) for t, rows in wanted.items()}
        present = self._append(heads, number)
        if record_only:
            return None
        mixed = self._attend(heads, present, number, name)
        mixed = entry.linear(mixed, weights + ".out", block.out, name + ".out")
        x = entry.op("Add", [x, mixed], name + ".attended")
        normed = entry.layer_norm(x, weights + ".norm2", block.norm2, name + ".norm2")
        up = entry.op("Relu", [entry.linear(normed, weights + ".up", block.up, name + ".up")], name + ".relu")
        down = entry.linear(up, weights + ".down", block.down, name + ".down")
        return entry.op("Add", [x, down], name + ".sum")

    def run(self, x, record_only=False):
        """Runs all blocks over tokens [1, new, d] -> the last token's row [1, d] after the final norm, None when only recording."""
        last = len(self.policy.blocks) - 1
        for number in range(last + 1):
            x = self.block(x, number, record_only=record_only and number == last)
        if record_only:
            return None
        place = self.entry.graph.constant(f"constants/last_token.{self.new}", np.int64(self.new - 1))
        x = self.entry.op("Gather", [x, place], "state_token", axis=1)
        return self.entry.layer_norm(x, f"{self.level}.norm", self.policy.norm, "state_normed")

    def _to_heads(self, rows, out, number):
        """Splits [1, new, hidden] into heads [1, heads, new, head_dim]. Without a cache, new keys and values are the present ones."""
        if not self.cached and not out.endswith("query"):
            out = f"present.{number}.{out.rsplit('.', 1)[1]}"
        split = self.entry.op("Reshape", [rows, self.split_heads], out + ".split")
        return self.entry.op("Transpose", [split], out, perm=[0, 2, 1, 3])

    def _append(self, heads, number):
        present = {}
        for kind in ("key", "value"):
            shape = [1, self.heads, f"P+{self.new}" if self.cached else self.new, self.head_dim]
            self.entry.output(f"present.{number}.{kind}", shape)
            present[kind] = heads[kind]
            if self.cached:
                past = self.entry.input(f"past_key_values.{number}.{kind}", [1, self.heads, "P", self.head_dim])
                present[kind] = self.entry.op("Concat", [past, heads[kind]], f"present.{number}.{kind}", axis=2)
        return present

    def _scores(self, query, keys, out):
        turned = self.entry.op("Transpose", [keys], out + ".keys", perm=[0, 1, 3, 2])
        product = self.entry.op("MatMul", [query, turned], out + ".product")
        return self.entry.op("Mul", [product, self.scale], out)

    def _attend(self, heads, present, number, name):
        """Computes attention with separate scores against the past and against the new keys: only the new block needs the causal mask."""
        entry = self.entry
        scores = self._scores(heads["query"], heads["key"], name + ".scores_new")
        if self.new > 1:
            scores = entry.op("Add", [scores, self.mask], name + ".scores_masked")
        if self.cached:
            past = f"{entry.name}/past_key_values.{number}.key"
            past_scores = self._scores(heads["query"], past, name + ".scores_past")
            scores = entry.op("Concat", [past_scores, scores], name + ".scores", axis=-1)
        shares = entry.op("Softmax", [scores], name + ".attention", axis=-1)
        mixed = entry.op("MatMul", [shares, present["value"]], name + ".mixed_heads")
        turned = entry.op("Transpose", [mixed], name + ".mixed_turned", perm=[0, 2, 1, 3])
        return entry.op("Reshape", [turned, self.join_heads], name + ".mixed")


def high_level_instruct(graph, policy, words_len):
    """Adds `high_level/instruct`: keys and values of all word rows; causal, so rows beyond an instruction's length change none before
    them."""
    entry = Entry(graph, "high_level/instruct")
    words = entry.input("words", [1, words_len, policy.embed_word.in_features])
    x = entry.linear(words, "high_level.embed_word", policy.embed_word, "word_tokens")
    x = entry.layer_norm(x, "high_level.embed_norm", policy.embed_norm, "tokens")
    Transformer(entry, policy, words_len, cached=False).run(x, record_only=True)


def high_level_state(graph, policy, normalizer, first=False, previous=None):
    """Adds the nodes of `high_level/start` or `high_level/step` up to the state token -> the entry, its row [1, d], the observation's
    embedding.

    previous: the name of the input for the previous action; without it the history is of observations only.
    """
    entry = Entry(graph, "high_level/start" if first else "high_level/step")
    tokens = []
    if previous and not first:
        action = entry.input(previous, [1, policy.embed_action.in_features])
    observation = entry.input(graph.observed, [1, policy.embed_observation.in_features])
    timestep = entry.input("timestep", [1], TensorProto.INT64)
    times = entry.weight("high_level.embed_timestep", policy.embed_timestep.weight)
    if previous and not first:
        before = entry.op("Sub", [timestep, entry.integers("one", [1])], "timestep_before")
        tokens.append(token(entry, action, policy.embed_action, (times, before), "action"))
    tokens.append(observed_token(entry, observation, policy, normalizer, (times, timestep)))
    x = tokens[0] if len(tokens) == 1 else entry.op("Concat", tokens, "token_pair", axis=1)
    x = entry.layer_norm(x, "high_level.embed_norm", policy.embed_norm, "tokens")
    return entry, Transformer(entry, policy, len(tokens), cached=True).run(x), f"{entry.name}/observation_embedded"


def head(entry, x, module, out, name="high_level.head"):
    """Adds a linear output of a row [1, d]."""
    entry.gemm(x, entry.weight(name + ".weight", module.weight), entry.weight(name + ".bias", module.bias), out)
    entry.output(out, [1, module.out_features])


def high_level_step(graph, policy, normalizer, first, out="logits", previous="action"):
    """Adds `high_level/start` (first: the observation only) and `high_level/step` (previous action, then observation)."""
    entry, x, _ = high_level_state(graph, policy, normalizer, first, previous)
    head(entry, x, policy.head, out)


def observed_token(entry, observation, policy, normalizer, time, level="high_level"):
    """Makes the token of an observation in raw units, or of one that is normalised already (no `normalizer`)."""
    observation, weight = raw(entry, observation, policy.embed_observation, normalizer)
    return token(entry, observation, policy.embed_observation, time, "observation", weight, level)


def raw(entry, observation, module, normalizer):
    """Returns the observation, centred, and the weights of the linear layer that reads it, divided by the standard deviation; both as they
    are where there is no normaliser."""
    if normalizer is None:
        return observation, module.weight
    return entry.centred(observation, normalizer, "observation_centred"), fold_std(module.weight, normalizer)


def token(entry, x, module, time, name, weight=None, level="high_level"):
    """Makes a token: x [1, k] -> [1, 1, d], linear embedding plus the row `time` = (table, index)."""
    weight = entry.weight(f"{level}.embed_{name}.weight", module.weight if weight is None else weight)
    embedded = entry.gemm(x, weight, entry.weight(f"{level}.embed_{name}.bias", module.bias), name + "_embedded")
    row = entry.op("Gather", list(time), name + "_time", axis=0)
    flat = entry.op("Add", [embedded, row], name + "_flat")
    return entry.op("Unsqueeze", [flat, entry.integers("axis_one", [1])], name + "_token")


def codebook_lookup(graph, codes):
    entry = Entry(graph, "codebook/lookup")
    index = entry.input("index", [1], TensorProto.INT64)
    entry.op("Gather", [entry.weight("codebook", codes), index], "plan", axis=0)
    entry.output("plan", [1, codes.shape[1]])


def low_level_act(graph, policy, normalizer):
    """Adds the low level's MLP with batch norm folded into the linear layer before it."""
    entry = Entry(graph, "low_level/act")
    observations = len(normalizer.mean)
    observation = entry.input(graph.observed, [1, observations])
    plan = entry.input("plan", [1, policy.first.in_features - observations])
    centred = entry.centred(observation, normalizer, "observation_centred")
    x = entry.op("Concat", [centred, plan], "observation_and_plan", axis=1)
    layers = [(fold_std(policy.first.weight, normalizer), policy.first.bias)]
    for linear, norm in zip(policy.middle, policy.norms):
        scale = double(norm.weight) / np.sqrt(double(norm.running_var) + norm.eps)
        bias = double(norm.bias) - scale * double(norm.running_mean)
        layers.append((scale[:, None] * double(linear.weight), bias))
    layers.append((policy.last.weight, policy.last.bias))
    for number, (weight, bias) in enumerate(layers):
        name = f"low_level.layer.{number}"
        final = number == len(layers) - 1
        out = "action" if final else f"layer.{number}"
        x = entry.gemm(x, entry.weight(name + ".weight", weight), entry.weight(name + ".bias", bias), out)
        if not final:
            x = entry.op("LeakyRelu", [x], out + ".leaky", alpha=policy.slope)
    entry.output("action", [1, policy.last.out_features])


def trajectory_encode(graph, encoder, codes, normalizer, horizon):
    """Adds the trajectory encoder: a whole segment of H steps to its latent and, where there are codes, the index of the nearest one. Of features,
    which no caller has, there is none."""
    if graph.observed != OBSERVATION:
        return
    entry = Entry(graph, "trajectory_encoder/encode")
    observation_len, hidden = len(normalizer.mean), encoder.lstm.hidden_size
    observations = entry.input("observations", [1, horizon, observation_len])
    actions = entry.input("actions", [1, horizon, encoder.embed_action.in_features])
    if encoder.relative:
        first = entry.op("Gather", [observations, entry.integers("encoder.first", [0] * horizon)], "first", axis=1)
        centred = entry.op("Sub", [observations, first], "observations_relative")
    else:
        centred = entry.centred(observations, normalizer, "observations_centred")
    joined = entry.op("Concat", [centred, actions], "joined", axis=2)
    sequence = entry.op("Transpose", [joined], "sequence", perm=[1, 0, 2])
    weight, bias = encoder.input_weights()
    order = lambda array: np.concatenate([np.split(array, 4)[gate] for gate in (0, 3, 1, 2)])  # ONNX: i, o, f, c
    inputs = entry.weight("encoder.lstm.input", order(fold_std(weight, normalizer))[None])
    recurrent = entry.weight("encoder.lstm.recurrent", order(double(encoder.lstm.weight_hh_l0))[None])
    biases = np.concatenate([order(double(bias)), order(double(encoder.lstm.bias_hh_l0))])[None]
    lstm = [sequence, inputs, recurrent, entry.weight("encoder.lstm.bias", biases)]
    _, final = entry.op("LSTM", lstm, ["lstm_outputs", "lstm_final"], hidden_size=hidden)
    x = entry.op("Reshape", [final, entry.integers("encoder.flat", [1, hidden])], "lstm_flat")
    linears = list(encoder.mlp)[::2]
    for number, module in enumerate(linears):
        name = f"encoder.mlp.{number}"
        final = number == len(linears) - 1
        out = "latent" if final else f"mlp.{number}"
        weight, bias = entry.weight(name + ".weight", module.weight), entry.weight(name + ".bias", module.bias)
        x = entry.gemm(x, weight, bias, out)
        if not final:
            x = entry.op("LeakyRelu", [x], out + ".leaky", alpha=encoder.mlp[1].negative_slope)
    entry.output("latent", [1, linears[-1].out_features])
    if codes is not None:
        nearest_code(entry, x, codes)


def nearest_code(entry, latent, codes):
    """Computes the index of the code nearest to a latent [1, D]."""
    offset = entry.op("Sub", [latent, entry.weight("codebook", codes)], "offset")
    square = entry.op("Mul", [offset, offset], "offset_squared")
    distance = entry.op("ReduceSum", [square, entry.integers("axis_one", [1])], "distance", keepdims=0)
    entry.op("ArgMin", [distance], "index", axis=0, keepdims=1)
    entry.output("index", [1], TensorProto.INT64)


def known_instructions(graph, policy, encoded):
    """Adds the table of instructions, and the entry that puts one into the high level's context."""
    words = np.zeros((len(encoded.instructions), encoded.max_words, encoded.dim), np.float32)
    for row, instruction in enumerate(encoded.instructions):
        words[row, : len(instruction.words)] = instruction.words
    lengths = [len(instruction.words) for instruction in encoded.instructions]
    instruction_lookup(graph, words, lengths)
    high_level_instruct(graph, policy, encoded.max_words)


def see(graph, networks):
    """Adds the encoder of frames of networks that have one; what is added after it reads its features."""
    if hasattr(networks, "frames"):
        networks.frames.add(graph)


def build(lads, encoded, horizon):
    """Builds all entries of one policy as one checked ONNX model, without metadata."""
    graph = Graph()
    codes = to_numpy(lads.codebook.codes)
    known_instructions(graph, lads.high_level, encoded)
    see(graph, lads)
    high_level_step(graph, lads.high_level, lads.normalizer, first=True)
    high_level_step(graph, lads.high_level, lads.normalizer, first=False)
    codebook_lookup(graph, codes)
    low_level_act(graph, lads.low_level, lads.normalizer)
    trajectory_encode(graph, lads.encoder, codes, lads.normalizer, horizon)
    model = graph.model("lads")
    onnx.checker.check_model(model, full_check=True)
    return model
