"""Tests the language encoder as files: equal to PyTorch, whole or not there, and only of models whose graph is known."""

import json

import numpy as np
import onnxruntime
import pytest
import tiny_encoder
from tokenizers import Tokenizer

from lads_exporter import language, language_graph
from lads_exporter.config import UserError


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("source") / "tiny-encoder"
    tiny_encoder.save(folder)
    return str(folder)


@pytest.mark.parametrize("make", [tiny_encoder.bert, tiny_encoder.distilbert])
def test_graph_and_tokeniser_alone_give_pytorchs_layers(make, tmp_path):
    source = str(tmp_path / "tiny-encoder")
    tiny_encoder.save(source, make)
    assert language_graph.write(source, tmp_path / "out")
    tokenizer, model, sha256 = language.load(source)
    manifest = json.loads((tmp_path / "out/manifest.json").read_text())
    assert manifest["sha256"] == sha256 and manifest["encoder"] == "tiny-encoder"
    alone = Tokenizer.from_file(str(tmp_path / "out/tokenizer.json"))
    session = onnxruntime.InferenceSession(tmp_path / "out/encoder.onnx")
    for text in (*tiny_encoder.SENTENCES, "open the drawer slowly, close the cupboard"):
        expected = np.stack([layer[0].numpy() for layer in language.hidden_layers(tokenizer, model, text)])
        ids = alone.encode(text).ids
        assert ids == tokenizer(text)["input_ids"], "neither cut nor filled up"
        (got,) = session.run(["encoder/hidden"], {"encoder/ids": np.array(ids, np.int64)})
        assert got.shape == expected.shape and np.abs(got - expected).max() < 1e-5


def test_a_whole_folder_stays_and_a_damaged_one_is_replaced(source, tmp_path):
    folder = tmp_path / "cache" / "tiny-encoder"
    assert language_graph.write(source, folder)
    assert not language_graph.write(source, folder), "a second run does nothing"
    model = (folder / "encoder.onnx").read_bytes()
    for damage in (lambda path: path.write_bytes(model[:99]), lambda path: path.unlink()):
        damage(folder / "encoder.onnx")
        assert not language_graph.is_whole(folder)
        assert language_graph.write(source, folder)
        assert (folder / "encoder.onnx").read_bytes() == model
    (folder / "manifest.json").write_text("{}")
    assert language_graph.write(source, folder)
    assert [path.name for path in folder.parent.iterdir()] == ["tiny-encoder"], "nothing half-written stays"


def test_a_failure_leaves_the_old_folder(source, tmp_path, monkeypatch):
    folder = tmp_path / "tiny-encoder"
    language_graph.write(source, folder)
    (folder / "encoder.onnx").write_bytes(b"damaged")
    monkeypatch.setattr(language_graph, "_compare", lambda *_: float("nan"))
    with pytest.raises(UserError, match="differs from PyTorch"):
        language_graph.write(source, folder)
    assert (folder / "encoder.onnx").read_bytes() == b"damaged"
    assert [path.name for path in tmp_path.iterdir()] == ["tiny-encoder"]


def test_refusals_name_what_is_wrong(source, tmp_path):
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes/diary.txt").write_text("precious")
    with pytest.raises(UserError, match="notes is something else"):
        language_graph.write(source, tmp_path / "notes")
    assert (tmp_path / "notes/diary.txt").read_text() == "precious"
    with pytest.raises(UserError, match="random-8 is an encoder for tests"):
        language_graph.write("random-8", tmp_path / "out")
    with pytest.raises(UserError, match="no folder with a config.json"):
        language_graph.write(str(tmp_path / "none"), tmp_path / "out")
    other = tmp_path / "other"
    tiny_encoder.save(other, lambda: tiny_encoder.bert(hidden_act="relu"))
    with pytest.raises(UserError, match="a bert model with activation relu"):
        language_graph.write(str(other), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_cache_is_where_the_variables_say(monkeypatch, tmp_path):
    monkeypatch.setenv("LADS_CACHE", str(tmp_path / "own"))
    assert language_graph.default_folder("some/where/bert") == tmp_path / "own/language/bert"
    monkeypatch.delenv("LADS_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert language_graph.cache_folder() == tmp_path / "lads"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert language_graph.cache_folder() == tmp_path / "home/.cache/lads"
