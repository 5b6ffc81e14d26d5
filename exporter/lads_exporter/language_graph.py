"""Exports the language encoder as files for hosts without Python, so that a policy can follow sentences outside its table.

A folder of three files: `encoder.onnx` (input `encoder/ids` [n] int64, the tokens of one sentence; output `encoder/hidden`
[layers + 1, n, E] float32, the embeddings and then every layer's output), `tokenizer.json`, and `manifest.json` with the sha256 of both and
of the weights, which is how bundles name an encoder. One folder serves every bundle of that encoder: layer and pooling are the contract's.
The graph is compared with PyTorch before anything is written, and the folder is there whole or not at all.
"""

import hashlib
import json
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto

from . import language
from .config import UserError
from .graphs import Entry, Graph, to_numpy

FORMAT, FORMAT_VERSION = "lads-language", 1
MODEL, TOKENIZER, MANIFEST = "encoder.onnx", "tokenizer.json", "manifest.json"
TOLERANCE = 1e-4
CHECKED = ("shut the cupboard", "Move the white mug to the left, then turn the faucet right!", "naïve café — 漢字 🙂", "antidisestablishmentarianism")


def cache_folder():
    """Returns the encoder's cache folder: $LADS_CACHE, else lads in $XDG_CACHE_HOME or ~/.cache; `lads-run` looks in the same place."""
    own, shared = os.environ.get("LADS_CACHE"), os.environ.get("XDG_CACHE_HOME")
    return Path(own) if own else (Path(shared) if shared else Path.home() / ".cache") / "lads"


def default_folder(encoder):
    return cache_folder() / "language" / language.name(encoder)


@dataclass(frozen=True)
class _Block:
    """Modules of one layer, by names that do not depend on the model."""

    query: object
    key: object
    value: object
    out: object
    norm1: object
    up: object
    down: object
    norm2: object


def _bert_block(layer):
    attention, inner = layer.attention, layer.attention.self
    mixing = (inner.query, inner.key, inner.value, attention.output.dense, attention.output.LayerNorm)
    return _Block(*mixing, layer.intermediate.dense, layer.output.dense, layer.output.LayerNorm)


def _distilbert_block(layer):
    attention = layer.attention
    mixing = (attention.q_lin, attention.k_lin, attention.v_lin, attention.out_lin, layer.sa_layer_norm)
    return _Block(*mixing, layer.ffn.lin1, layer.ffn.lin2, layer.output_layer_norm)


def _blocks(encoder, model):
    config = model.config
    kind = config.model_type
    activation = getattr(config, "activation" if kind == "distilbert" else "hidden_act", None)
    positions = getattr(config, "position_embedding_type", None) or "absolute"
    if kind not in ("bert", "distilbert") or activation != "gelu" or positions != "absolute":
        form = f"{kind} model with activation {activation} and {positions} positions"
        raise UserError(f"{encoder}: a {form}; only BERT and DistilBERT with gelu and absolute ones are exported, use one of these")
    if kind == "bert":
        return [_bert_block(layer) for layer in model.encoder.layer]
    return [_distilbert_block(layer) for layer in model.transformer.layer]


class _Network:
    """Nodes of BERT or DistilBERT, for one sentence without padding."""

    def __init__(self, model, blocks):
        self.model, self.blocks = model, blocks
        self.heads_len, self.hidden = model.config.num_attention_heads, model.config.hidden_size
        self.graph = Graph()
        self.entry = Entry(self.graph, "encoder")
        self.ids = self.entry.input("ids", ["N"], TensorProto.INT64)

    def layer_norm(self, x, name, module, out):
        entry = self.entry
        scale, bias = entry.weight(name + ".scale", module.weight), entry.weight(name + ".bias", module.bias)
        return entry.op("LayerNormalization", [x, scale, bias], out, axis=-1, epsilon=module.eps)

    def embed(self):
        """Embeds words and positions (BERT: of the first sentence's type), normalised."""
        entry, tables = self.entry, self.model.embeddings
        words = entry.op("Gather", [entry.weight("words", tables.word_embeddings.weight), self.ids], "words", axis=0)
        places = to_numpy(tables.position_embeddings.weight)
        if hasattr(tables, "token_type_embeddings"):
            places = places + to_numpy(tables.token_type_embeddings.weight)[0]
        tokens = entry.op("Shape", [self.ids], "tokens")
        bounds = [entry.integers("first", [0]), tokens, entry.integers("rows", [0])]
        places = entry.op("Slice", [entry.weight("positions", places), *bounds], "positions")
        summed = entry.op("Add", [words, places], "embedded")
        return self.layer_norm(summed, "norm", tables.LayerNorm, "layer.0")

    def heads(self, x, name, module):
        """Splits [n, E] into heads [heads, n, E / heads]."""
        entry = self.entry
        rows = entry.linear(x, name, module, name + ".rows")
        shape = entry.integers("split_heads", [0, self.heads_len, self.hidden // self.heads_len])
        return entry.op("Transpose", [entry.op("Reshape", [rows, shape], name + ".split")], name, perm=[1, 0, 2])

    def attend(self, x, name, block):
        entry = self.entry
        query, key, value = (self.heads(x, f"{name}.{part}", getattr(block, part)) for part in ("query", "key", "value"))
        turned = entry.op("Transpose", [key], name + ".keys", perm=[0, 2, 1])
        product = entry.op("MatMul", [query, turned], name + ".product")
        scale = entry.graph.constant("constants/attention_scale", np.float32((self.hidden // self.heads_len) ** -0.5))
        shares = entry.op("Softmax", [entry.op("Mul", [product, scale], name + ".scores")], name + ".attention", axis=-1)
        mixed = entry.op("Transpose", [entry.op("MatMul", [shares, value], name + ".mixed_heads")], name + ".turned", perm=[1, 0, 2])
        mixed = entry.op("Reshape", [mixed, entry.integers("join_heads", [0, self.hidden])], name + ".mixed")
        return entry.linear(mixed, name + ".out", block.out, name + ".attended")

    def gelu(self, x, name):
        """Computes GELU: x/2 (1 + erf(x / sqrt 2))."""
        entry, constant = self.entry, lambda key, value: self.graph.constant(f"constants/{key}", np.float32(value))
        part = entry.op("Erf", [entry.op("Mul", [x, constant("root_half", 0.5**0.5)], name + ".scaled")], name + ".erf")
        part = entry.op("Add", [part, constant("one", 1.0)], name + ".raised")
        return entry.op("Mul", [entry.op("Mul", [x, part], name + ".twice"), constant("half", 0.5)], name)

    def block(self, x, number, block):
        entry, name = self.entry, f"block.{number}"
        mixed = entry.op("Add", [x, self.attend(x, name, block)], name + ".joined")
        x = self.layer_norm(mixed, name + ".norm1", block.norm1, name + ".normed")
        up = self.gelu(entry.linear(x, name + ".up", block.up, name + ".up"), name + ".gelu")
        down = entry.linear(up, name + ".down", block.down, name + ".down")
        return self.layer_norm(entry.op("Add", [x, down], name + ".sum"), name + ".norm2", block.norm2, f"layer.{number + 1}")

    def build(self):
        layers = [self.embed()]
        for number, block in enumerate(self.blocks):
            layers.append(self.block(layers[-1], number, block))
        rows = [self.entry.op("Unsqueeze", [x, self.entry.integers("axis_zero", [0])], f"{x.split('/')[1]}.row") for x in layers]
        self.entry.op("Concat", rows, "hidden", axis=0)
        self.entry.output("hidden", [len(layers), "N", self.hidden])
        model = self.graph.model("language-encoder")
        onnx.checker.check_model(model, full_check=True)
        return model


def _compare(data, tokenizer, model):
    """Computes the largest difference from PyTorch over a few sentences of different scripts and lengths."""
    import onnxruntime

    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    worst = 0.0
    for text in CHECKED:
        expected = np.stack([layer[0].numpy() for layer in language.hidden_layers(tokenizer, model, text)])
        ids = np.array(tokenizer(text)["input_ids"], np.int64)
        (got,) = session.run(["encoder/hidden"], {"encoder/ids": ids})
        worst = max(worst, float(np.abs(got - expected).max()))
    return worst


def _tokenizer_json(tokenizer):
    """Returns the tokeniser alone: no padding, and no cutting, which would lose words without a message."""
    backend = tokenizer.backend_tokenizer
    backend.no_padding()
    backend.no_truncation()
    return backend.to_str().encode()


def _sha256(data):
    return hashlib.sha256(data).hexdigest()


def is_whole(folder, sha256=None):
    """Whether a folder holds an encoder as its manifest says (and, where given, one of these weights)."""
    try:
        manifest = json.loads((Path(folder) / MANIFEST).read_text(encoding="utf-8"))
        known = (manifest["format"], manifest["format_version"]) == (FORMAT, FORMAT_VERSION) and sha256 in (None, manifest["sha256"])
        return known and all(_sha256((Path(folder) / file).read_bytes()) == digest for file, digest in manifest["files"].items())
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False


def _replace(folder, files):
    """Replaces a folder whole: all files are written into one beside it, which then takes its place."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}-") as scratch:
        new, old = Path(scratch) / "new", Path(scratch) / "old"
        new.mkdir()
        for file, data in files.items():
            (new / file).write_bytes(data)
        if folder.exists():
            folder.rename(old)
        new.rename(folder)


def write(encoder, folder):
    """Exports the encoder, unless the folder holds it already; returns whether it wrote."""
    if encoder.startswith("random-"):
        raise UserError(f"{encoder} is an encoder for tests, without a network; name a BERT-family model")
    folder = Path(os.path.realpath(folder))  # a link stays one
    if folder.exists() and not (folder / MANIFEST).is_file() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(f"{folder} is something else than a language encoder; name another folder")
    if is_whole(folder, language.weights_sha256(encoder)):
        return False
    tokenizer, model, sha256 = language.load(encoder)
    data = _Network(model, _blocks(encoder, model)).build().SerializeToString(deterministic=True)
    difference = _compare(data, tokenizer, model)
    if not difference <= TOLERANCE:
        raise UserError(f"{encoder}: the exported graph differs from PyTorch by {difference:.1e}; nothing was written")
    files = {MODEL: data, TOKENIZER: _tokenizer_json(tokenizer)}
    manifest = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "encoder": language.name(encoder),
        "sha256": sha256,
        "layers": model.config.num_hidden_layers + 1,
        "dim": model.config.hidden_size,
        "max_tokens": model.config.max_position_embeddings,
        "files": {file: _sha256(content) for file, content in files.items()},
    }
    _replace(folder, files | {MANIFEST: (json.dumps(manifest, indent=2) + "\n").encode()})
    return True
