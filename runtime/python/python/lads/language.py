"""Turns sentences in any words into the word embeddings that a policy hears, by the language encoder that made the policy's own.

The encoder is a folder that `python -m lads_exporter language` writes once; it runs by onnxruntime and tokenizers, which
`pip install 'lads[language]'` adds. A policy follows any words, nonsense too: ask `Policy.nearest` before a sentence is followed. What can fail,
each as one `LanguageError`: the encoder is missing, damaged or another one; a sentence is empty or longer than encoder or policy can take.
"""

import hashlib
import json
import os
from pathlib import Path

import numpy as np

from ._lads import Policy
from .errors import LanguageError

_FORMAT, _FORMAT_VERSION = "lads-language", 1
_MODEL, _TOKENIZER, _MANIFEST = "encoder.onnx", "tokenizer.json", "manifest.json"
_AGAIN = "export it again with `python -m lads_exporter language`"
_TOLERANCE = 1e-3  # of a word's elements: the same encoder in another engine
_SHOWN = 60
_LONGEST = 10_000  # letters: a tokeniser takes its time for more, only to find that they are too many


def default_folder(encoder: str) -> Path:
    """Returns the folder into which the exporter writes an encoder: `language/NAME` in `$LADS_CACHE`, else in `lads` in `$XDG_CACHE_HOME` or `~/.cache`."""
    if not encoder or encoder.startswith(".") or any(c in "/\\:" or not c.isprintable() for c in encoder):
        raise LanguageError(f"the policy's language encoder is called {encoder!r}, which names no folder; export the bundle again")
    own, shared, home = (os.environ.get(name) for name in ("LADS_CACHE", "XDG_CACHE_HOME", "HOME"))
    cache = own or (shared and os.path.join(shared, "lads")) or (home and os.path.join(home, ".cache", "lads"))
    if not cache:
        raise LanguageError("no folder for the language encoder: none of LADS_CACHE, XDG_CACHE_HOME and HOME is set; set LADS_CACHE")
    return Path(cache) / "language" / encoder


class Encoder:
    """A language encoder that was loaded for one policy.

    `folder` is where the exporter wrote it, by default where it does (`default_folder`). The encoder is taken if it has the weights that the
    policy's contract names and makes the words of its first known instruction, by one of its layers or by the mean of the last over all tokens,
    which is then what it returns of other sentences.
    """

    def __init__(self, policy: Policy, folder: str | os.PathLike[str] | None = None) -> None:
        if not hasattr(policy, "contract"):
            raise TypeError(f"policy: it is a {type(policy).__name__}; give what lads.open returns")
        language, known = policy.contract.language, policy.contract.instructions
        if language is None or not known:
            raise LanguageError(f"{policy.path}: the policy takes no instructions, so no sentence can be put to it; leave the sentence out")
        try:
            self._folder = default_folder(language.encoder) if folder is None else Path(os.fsdecode(folder))
        except TypeError as error:
            raise LanguageError(f"folder: a path, not {type(folder).__name__}; give where `python -m lads_exporter language` wrote the encoder") from error
        self._manifest = self._read(language)
        self._most = policy.contract.context.words
        self._tokenizer, self._network = self._load()
        first = known[0]
        self._heard = self._like(first.text, policy.words(first.id))

    @property
    def folder(self) -> Path:
        """The folder that the encoder was loaded from."""
        return self._folder

    def words(self, text: str) -> np.ndarray:
        """Computes the word embeddings of a sentence: float32 `[words, dim]`, for `Controller.instruct` and `Policy.nearest`."""
        ids = self._tokens(text)
        longest = ((len(ids), self._manifest["max_tokens"], "the language encoder"), (len(ids) - 1, self._most, "the policy"))
        for got, most, who in longest[: 1 if self._heard is None else 2]:
            if got > most:
                raise LanguageError(f"{_shown(text)}: {got} word pieces, {who} takes at most {most}; use fewer words")
        return self._of(self._hidden(text, ids), self._heard)

    def _read(self, language):
        """Reads the manifest, and checks that it is of the policy's encoder."""
        path = self._folder / _MANIFEST
        try:
            content = path.read_bytes()
        except (FileNotFoundError, NotADirectoryError) as error:
            raise LanguageError(
                f"the language encoder {language.encoder} is not in {self._folder}; export it once with `python -m lads_exporter language`"
            ) from error
        except (OSError, ValueError) as error:
            raise LanguageError(f"{path}: it cannot be read ({_line(error)}); {_AGAIN}") from error
        try:
            found = json.loads(content)
            version = (found["format"], found["format_version"])
            texts = [found["sha256"], *found["files"].values()]
            sizes = [found[key] for key in ("layers", "dim", "max_tokens")]
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise LanguageError(f"{path}: no manifest of a language encoder ({_line(error)}); {_AGAIN}") from error
        if version != (_FORMAT, _FORMAT_VERSION) or type(version[1]) is not int:
            raise LanguageError(f"{path}: says {_shown(str(version))}, this program reads {(_FORMAT, _FORMAT_VERSION)}; {_AGAIN}")
        # Not isinstance: true is an int.
        if not all(isinstance(text, str) for text in texts) or not all(type(size) is int and size > 0 for size in sizes):
            raise LanguageError(f"{path}: no manifest of a language encoder (its sizes or checksums are none); {_AGAIN}")
        if found["sha256"] != language.sha256:
            raise LanguageError(
                f"the language encoder in {self._folder} has weights of sha256 {_line(found['sha256'])[:12]}, the policy's words were made by {language.encoder}"
                f" with {language.sha256[:12]}; name the folder of that one, or export it with `python -m lads_exporter language`"
            )
        return found

    def __reduce__(self):
        raise LanguageError("an encoder cannot be pickled; make one in every process, of the policy, which can")

    def _file(self, name):
        """Reads a file of the folder, if it has the checksum that the manifest states."""
        path = self._folder / name
        try:
            content = path.read_bytes()
        except (OSError, ValueError) as error:
            raise LanguageError(f"{path}: {_line(error)}; {_AGAIN}") from error
        digest = hashlib.sha256(content).hexdigest()
        if self._manifest["files"].get(name) != digest:
            raise LanguageError(f"{path}: its sha256 {digest[:12]} is not the manifest's; {_AGAIN}")
        return content

    def _load(self):
        try:
            import onnxruntime
            from tokenizers import Tokenizer
        except ImportError as error:
            raise LanguageError(f"a sentence needs onnxruntime and tokenizers ({error}); run: pip install 'lads[language]'") from error
        # Neither engine has exceptions of a class of its own.
        try:
            tokenizer = Tokenizer.from_buffer(self._file(_TOKENIZER))
        except LanguageError:
            raise
        except Exception as error:
            raise LanguageError(f"{self._folder / _TOKENIZER}: no tokeniser ({_line(error)}); {_AGAIN}") from error
        model, options = self._file(_MODEL), onnxruntime.SessionOptions()
        options.log_severity_level = 4
        try:
            network = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        except Exception as error:
            raise LanguageError(f"{self._folder / _MODEL}: no network that runs ({_line(error)}); {_AGAIN}") from error
        return tokenizer, network

    def _tokens(self, text):
        if not isinstance(text, str):
            raise LanguageError(f"a sentence is a str, not {type(text).__name__}; give the text of an instruction")
        if len(text) > _LONGEST:
            raise LanguageError(f"{_shown(text)}: a sentence of {len(text)} letters; no language encoder takes as many, use fewer words")
        try:
            found = self._tokenizer.encode(text)
        except Exception as error:
            raise LanguageError(f"{_shown(text)}: the tokeniser failed ({_line(error)}); give text in UTF-8") from error
        if not text.strip() or all(found.special_tokens_mask):
            raise LanguageError(f"{_shown(text)}: an empty sentence; give an instruction")
        return found.ids

    def _hidden(self, text, ids):
        """Computes all hidden layers [layers, tokens, dim] of a sentence."""
        (layers, dim), failed = (self._manifest[key] for key in ("layers", "dim")), f"{_shown(text)}: the language encoder failed"
        try:
            hidden = self._network.run(None, {self._network.get_inputs()[0].name: np.array(ids, np.int64)})[0]
        except Exception as error:
            raise LanguageError(f"{failed} ({_line(error)}); {_AGAIN}") from error
        if hidden.shape != (layers, len(ids), dim):
            raise LanguageError(f"{failed} (it gives {list(hidden.shape)} numbers, not {[layers, len(ids), dim]}); {_AGAIN}")
        return hidden

    def _like(self, text, words):
        """Finds the layer that `words` are of, without its first token; None if they are the mean of the last over all tokens."""
        hidden = self._hidden(text, self._tokens(text))
        found = [(layer, self._of(hidden, layer)) for layer in (None, *range(len(hidden)))]
        far = [(float(np.abs(made - words).max()), layer) for layer, made in found if made.shape == words.shape]
        nearest = min(far, key=lambda row: row[0], default=(np.inf, None))
        if not nearest[0] <= _TOLERANCE:
            raise LanguageError(
                f"the language encoder in {self._folder} does not make the policy's words of {_shown(text)} (nearest layer off by {nearest[0]:.2g});"
                " export the bundle again"
            )
        return nearest[1]

    @staticmethod
    def _of(hidden, layer):
        found = hidden[-1].mean(0, keepdims=True) if layer is None else hidden[layer, 1:]
        return np.ascontiguousarray(found, np.float32)


def _line(error):
    """Returns what an engine or the system says, as one line of bounded length."""
    return " ".join(str(error).split())[:200]


def _shown(text):
    """Shortens a sentence for messages: one line of bounded length."""
    return repr(text[:_SHOWN] + "…" * (len(text) > _SHOWN))
