"""Tests sentences outside a policy's table: words as the exporter's, and everything that is refused."""

import json
import os
import pickle

import numpy as np
import pytest
from conftest import PROJECT

import lads
from lads.errors import InstructionError, LanguageError
from lads.language import Encoder, default_folder

SENTENCES = ("pull the drawer out", "Please, open the DRAWER  a little - and then turn the tap to the left!", "把水龙头向左转", "🙂 wash the cup", "x")
TOLERANCE = 1e-4


@pytest.fixture(scope="module")
def policies():
    """A policy that hears every word, and one that hears their mean."""
    return {name: lads.open(PROJECT / f"models/{name}.onnx") for name in ("kitchen", "lorel")}


@pytest.fixture(scope="module")
def folder(language_cache, policies):
    """The encoder of both."""
    return language_cache / "language" / policies["lorel"].contract.language.encoder


@pytest.mark.parametrize("name", ["kitchen", "lorel"])
def test_words_are_the_exporters(policies, folder, name):
    config, language = pytest.importorskip("lads_exporter.config"), pytest.importorskip("lads_exporter.language")
    policy = policies[name]
    setting = config.load(PROJECT / f"exporter/configs/{name}.toml").config.language
    encoder = Encoder(policy, folder)
    for known in policy.contract.instructions[:5]:
        assert np.abs(encoder.words(known.text) - policy.words(known.id)).max() <= TOLERANCE
    for text, encoded in zip(SENTENCES, language.encode(setting, SENTENCES).instructions, strict=True):
        words = encoder.words(text)
        assert words.dtype == np.float32 and words.shape == encoded.words.shape
        assert np.abs(words - encoded.words).max() <= TOLERANCE, text


def test_a_sentence_is_followed_if_it_is_like_a_known_one(policies, folder, language_cache, monkeypatch):
    monkeypatch.setenv("LADS_CACHE", str(language_cache))
    policy = policies["lorel"]
    encoder = Encoder(policy)
    assert encoder.folder == folder == default_folder(policy.contract.language.encoder)
    words = encoder.words("tug the drawer open")
    nearest = policy.nearest(words)
    assert nearest.accepted and "drawer" in nearest.instruction.text and 0.5 < nearest.similarity < 1
    controller = policy.controller(words)
    observation = policy.golden.observations["observation"][0]
    controller.step(observation)
    assert controller.instructed and controller.instruction is None
    other = policy.nearest(encoder.words("recite a poem about the sea"))
    assert not other.accepted and other.similarity < policy.contract.language.acceptance


def test_known_words_are_nearest_to_themselves(kitchen):
    for known in kitchen.contract.instructions:
        words = kitchen.words(known.id)
        assert words.shape == (known.words, kitchen.contract.language.dim) and words.dtype == np.float32
        assert np.array_equal(words, kitchen.words(known.text))
        nearest = kitchen.nearest(words)
        assert nearest.similarity > 0.999 and nearest.accepted
    with pytest.raises(InstructionError, match="'nosuch'"):
        kitchen.words("nosuch")
    with pytest.raises(InstructionError, match="lads.language.Encoder"):
        kitchen.nearest(known.id)
    with pytest.raises(InstructionError, match="3 elements each"):
        kitchen.nearest(np.zeros((2, 3), np.float32))
    for wrong in (0, None, words, "\ud800"):
        with pytest.raises(InstructionError):
            kitchen.words(wrong)
    # What the controller would refuse is not near anything.
    dim = kitchen.contract.language.dim
    for wrong, said in ((np.ones((99, dim)), "99 words"), (np.ones((0, dim)), "0 words"), (np.full((1, dim), np.nan), "not finite")):
        with pytest.raises(InstructionError, match=said):
            kitchen.nearest(wrong.astype(np.float32))


def test_a_policy_without_instructions_hears_nothing(plain):
    with pytest.raises(LanguageError, match="takes no instructions"):
        Encoder(plain)
    with pytest.raises(InstructionError, match="takes no instruction"):
        plain.nearest(np.zeros((2, 3), np.float32))


def test_sentences_that_cannot_be_heard_are_refused(policies, folder):
    encoder, pooled = Encoder(policies["kitchen"], folder), Encoder(policies["lorel"], folder)
    with pytest.raises(LanguageError, match="cannot be pickled"):
        pickle.dumps(encoder)
    refused = [(" ", "' ': an empty sentence"), ("", "an empty"), ("go " * 100, "the policy takes at most"), (7, "a str, not int"), ("go " * 600, "the language encoder takes at most")]
    for text, said in refused:
        with pytest.raises(LanguageError, match=said) as error:
            encoder.words(text)
        assert "\n" not in str(error.value)
    assert pooled.words("go " * 100).shape == (1, 384), "the mean is one word"


def test_other_encoders_are_refused(policies, folder, tmp_path, monkeypatch):
    policy = policies["kitchen"]
    with pytest.raises(LanguageError, match="python -m lads_exporter language"):
        Encoder(policy, tmp_path / "nowhere")
    manifest = json.loads((folder / "manifest.json").read_text())

    def changed(place, content=None, **fields):
        other = tmp_path / place
        other.mkdir()
        for name in ("encoder.onnx", "tokenizer.json"):
            os.link(folder / name, other / name)
        (other / "manifest.json").write_text(json.dumps(manifest | fields) if content is None else content)
        return other

    files = manifest["files"] | {"encoder.onnx": "0" * 64}
    cases = [
        ("weights", None, {"sha256": "0" * 64}, "sha256 000000000000"),
        ("version", None, {"format_version": 9}, "this program reads"),
        ("damaged", None, {"files": files}, "is not the manifest's"),
        ("sizes", None, {"layers": 3}, "not \\[3, "),
        ("fields", None, {"layers": "7"}, "sizes or checksums"),
        ("truth", None, {"layers": True}, "sizes or checksums"),
        ("float", None, {"format_version": 1.0}, "this program reads"),
        ("long", None, {"format": "z\n" * 10000}, "this program reads"),
        ("deep", "[" * 200000, {}, "no manifest"),
        ("list", "[]", {}, "no manifest"),
        ("json", "{", {}, "no manifest"),
    ]
    for place, content, fields, said in cases:
        with pytest.raises(LanguageError, match=said) as error:
            Encoder(policy, changed(place, content, **fields))
        assert place in str(error.value) or place == "sizes", place
        assert "\n" not in str(error.value) and len(str(error.value)) < 600
    # The right weights, and words of another sentence: the bundle's table was made otherwise.
    with pytest.raises(LanguageError, match="nearest layer off by"):
        Encoder(_Elsewhere(policy), folder)
    for folder_, said in ((tmp_path / ("a" * 300), "cannot be read"), (7, "a path, not int"), ("nul\0", "cannot be read")):
        with pytest.raises(LanguageError, match=said):
            Encoder(policy, folder_)
    for name in ("LADS_CACHE", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(LanguageError, match="set LADS_CACHE"):
        Encoder(policy)
    for name in ("", "../up", "a/b", ".hidden"):
        with pytest.raises(LanguageError, match="names no folder"):
            default_folder(name)


class _Elsewhere:
    """A policy whose words are another instruction's."""

    def __init__(self, policy):
        self.contract, self.path, self._policy = policy.contract, policy.path, policy

    def words(self, _id):
        return self._policy.words(self.contract.instructions[0].id)[::-1]


def test_without_the_engines_one_line_says_what_to_install(policies, folder, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "tokenizers", None)
    with pytest.raises(LanguageError, match=r"pip install 'lads\[language\]'"):
        Encoder(policies["kitchen"], folder)
