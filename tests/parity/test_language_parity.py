"""Tests the language encoder outside Python: embeddings of `lads-language`, and what `lads-run` makes of them.

The encoder is exported once for all tests here. Skipped where the exporter's environment is missing.
"""

import json
import os
import re
import shutil
import subprocess

import pytest

language = pytest.importorskip("lads_exporter.language")
import onnx  # noqa: E402
from lads_exporter import acceptance, config, language_graph  # noqa: E402
from programs import ROOT, SELECTION, newest  # noqa: E402

REFUSED = 2
# The Makefile's: with another one cargo would build tract once more.
SENTENCES = (
    "pull the drawer out",
    "Please, open the DRAWER  a little - and then turn the tap to the left!",
    "slide it: over there?",
    "déplace la tasse noire",
    "把水龙头向左转",
    "🙂 wash the cup",
    "antidisestablishmentarianism",
    "x",
)


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cache")
    for name in ("kitchen", "lorel"):
        calibrated = acceptance.read(ROOT / f"models/{name}.acceptance.json")
        onnx.save(acceptance.into(onnx.load(ROOT / f"models/{name}.onnx"), calibrated), folder / f"{name}.onnx")
    assert language_graph.write(language.DEFAULT, folder / "language" / language.DEFAULT)
    yield folder
    shutil.rmtree(folder)


def test_embeddings_are_the_exporters(cache):
    """Compares the embeddings of all instructions of the shipped bundles, and of sentences outside their tables, to 1e-4."""
    folder = cache / "language" / language.DEFAULT
    cases = []
    for name in ("kitchen", "lorel"):
        setting = config.load(ROOT / f"exporter/configs/{name}.toml")
        texts = [row["text"] for row in setting.instructions]
        known = [embedded.words for embedded in language.encode(setting.config.language, texts).instructions]
        for text, embedded in zip(SENTENCES, language.encode(setting.config.language, SENTENCES).instructions, strict=True):
            index, similarity = acceptance.nearest(embedded.words, known)
            like = {"nearest": setting.instructions[index]["id"], "similarity": similarity}
            cases.append({"bundle": name, "text": text, "words": embedded.words.ravel().tolist(), **like})
    (folder / "cases.json").write_text(json.dumps(cases))
    command = ["cargo", "test", *SELECTION, "--test", "exporter", "--", "--ignored", "--nocapture"]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {"LADS_LANGUAGE": str(folder)}, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    compared = re.findall(r"(\w+): (\d+) sentences, largest difference (\S+)", done.stdout)
    assert [name for name, *_ in compared] == ["kitchen", "lorel"], done.stdout
    print(compared)


def lads_run(cache, model, *arguments):
    """Runs lads-run on the shipped bundle with its calibration, where the cache has that -> exit code, stdout, stderr."""
    program = newest("lads-run")
    calibrated = cache / f"{model}.onnx"
    job = [arguments[0]] if arguments and arguments[0] == "replay" else []
    command = [program, *job, "--model", calibrated if calibrated.is_file() else ROOT / f"models/{model}.onnx", *arguments[len(job) :]]
    done = subprocess.run(command, env=os.environ | {"LADS_CACHE": str(cache)}, capture_output=True, text=True, timeout=300)
    if "built without the language encoder" in done.stderr:
        pytest.skip("lads-run is built without the feature `language`: run `make test-exporter`")
    return done.returncode, done.stdout, done.stderr


def results(cache, folder, model, *arguments):
    """Runs lads-run -> the table, the JSON."""
    file = folder / "results.json"
    code, table, wrong = lads_run(cache, model, "--episodes", "1", "--json", file, *arguments)
    assert code == 0, wrong
    return table, json.loads(file.read_text())


def refusal(cache, model, *arguments):
    code, out, wrong = lads_run(cache, model, *arguments)
    assert code == REFUSED and out == "" and len(wrong.splitlines()) == 1, (code, out, wrong)
    return wrong


@pytest.mark.parametrize(("model", "arguments", "count"), [("lorel", (), 101), ("kitchen", ("--instruction", "mkbs"), 1)])
def test_table_and_encoder_make_the_same_episodes(cache, tmp_path, model, arguments, count):
    """Tests all of LOReL's instructions, among them the 71 rephrased ones."""
    _, table = results(cache, tmp_path, model, *arguments)
    text, heard = results(cache, tmp_path, model, *arguments, "--encode-language")
    assert f"{count} instructions heard by the language encoder" in text
    assert 0 < heard["heard_by"]["largest_difference"] < 1e-4 and "heard_by" not in table
    assert len(table["instructions"]) == count
    assert heard["instructions"] == table["instructions"], "the same steps, plans and completions"
    if model == "lorel":
        assert sum(row["split"] == "rephrased" for row in heard["instructions"]) == 71


def test_a_sentence_outside_the_table_runs_without_a_success_rate(cache, tmp_path):
    table, found = results(cache, tmp_path, "lorel", "--instruction", "pull the drawer out")
    (row,) = found["instructions"]
    assert (row["id"], row["text"], row["split"]) == ("free", "pull the drawer out", "free")
    (run,) = row["runs"]
    assert row["full_success"] is None and row["n_rate"] is None and run["success"] is None
    assert run["steps"] == 40 and len(run["plans"]) == 8, "the benchmark's longest episode, to its end"
    assert found["splits"]["free"]["episodes"] == 1 and found["heard_by"]["largest_difference"] is None
    assert table.startswith("'pull the drawer out': the nearest known instruction is 'pull ") and "no success rate" in table
    assert "of these un-instructed by 'pull " in table
    nearest = found["heard_by"]["nearest"]
    assert nearest["accepted"] and nearest["similarity"] >= nearest["threshold"] > 0.5


def test_a_sentence_is_judged_by_the_sub_tasks_that_are_named(cache, tmp_path):
    table, found = results(cache, tmp_path, "lorel", "--instruction", "pull the drawer out", "--sub-tasks", "open drawer")
    (row,) = found["instructions"]
    assert [of["sub_task"] for of in row["completions"]] == ["open drawer"]
    assert row["full_success"] in (0, 1) and row["runs"][0]["success"] in (True, False)
    assert row["runs"][0]["steps"] <= 20, "as long as the benchmark's episodes of this sub-task"
    _, other = results(cache, tmp_path, "kitchen", "--instruction", "open the microwave, please", "--sub-tasks", "microwave")
    assert other["instructions"][0]["runs"][0]["steps"] <= 280
    assert "no success rate" not in table


def test_a_sentence_unlike_what_is_known_is_refused_unless_insisted_on(cache, tmp_path):
    for model in ("kitchen", "lorel"):
        threshold = acceptance.read(ROOT / f"models/{model}.acceptance.json")["acceptance"]["threshold"]
        for text in ("asdf qwerty", "do nothing, stay where you are", "bring me a cup of coffee"):
            wrong = refusal(cache, model, "--instruction", text)
            for part in (text, "nearest known instruction is '", "similarity 0.", f"from {threshold} on", "--sentence-anyway"):
                assert part in wrong, wrong
    table, found = results(cache, tmp_path, "lorel", "--instruction", "asdf qwerty", "--sentence-anyway")
    first, *rest = table.splitlines()
    assert "nearest known" in first and "followed because of --sentence-anyway" in first
    nearest = found["heard_by"]["nearest"]
    assert not nearest["accepted"] and nearest["similarity"] < nearest["threshold"]
    done = [of["sub_task"] for of in found["instructions"][0]["un_instructed_completions"]]
    (line,) = [line for line in rest if line.startswith("completed in 1 episodes: ")]
    assert all(f"{sub_task} 1" in line for sub_task in done) and (done or "nothing" in line)


def test_without_a_threshold_no_sentence_is_followed_without_insistence(cache, tmp_path):
    model = onnx.load(ROOT / "models/lorel.onnx")
    (row,) = [row for row in model.metadata_props if row.key == "lads.contract"]
    contract = json.loads(row.value)
    contract["language"].pop("acceptance", None)
    row.value = json.dumps(contract)
    bare = tmp_path / "bare"
    bare.mkdir()
    (bare / "language").symlink_to(cache / "language")
    onnx.save(model, bare / "lorel.onnx")
    wrong = refusal(bare, "lorel", "--instruction", "pull the drawer out")
    assert "does not say from where on" in wrong and "--sentence-anyway" in wrong
    _, found = results(bare, tmp_path, "lorel", "--instruction", "pull the drawer out", "--sentence-anyway")
    assert found["heard_by"]["nearest"]["threshold"] is None and not found["heard_by"]["nearest"]["accepted"]


@pytest.mark.parametrize("name", ["kitchen", "kitchen-small", "lorel"])
def test_calibrations_can_be_made_again(name):
    kept = acceptance.read(ROOT / f"models/{name}.acceptance.json")
    setting = config.load(ROOT / f"exporter/configs/{name}.toml")
    sentences = ROOT / f"exporter/configs/{name.removesuffix('-small')}.sentences.json"
    again = acceptance.calibrate(setting, acceptance.read_sentences(sentences, setting))
    assert again["language"] == kept["language"] and again["instructions_sha256"] == kept["instructions_sha256"]
    assert abs(again["acceptance"]["threshold"] - kept["acceptance"]["threshold"]) <= 0.002
    for one, other in zip(again["sentences"], kept["sentences"], strict=True):
        assert one["text"] == other["text"] and abs(one["similarity"] - other["similarity"]) <= 0.001, one


def test_a_log_of_a_sentence_replays(cache, tmp_path):
    log = tmp_path / "flight.mcap"
    results(cache, tmp_path, "lorel", "--instruction", "pull the drawer out", "--log", log)
    code, out, wrong = lads_run(cache, "lorel", "replay", log)
    assert code == 0 and out.startswith("EQUAL: 1 episodes"), out + wrong


def test_refusals(cache, tmp_path):
    long = "and then turn the faucet " * 120
    assert "takes at most 24" in refusal(cache, "kitchen", "--instruction", "open the microwave, please, " * 5)
    assert "takes at most 512" in refusal(cache, "lorel", "--instruction", long)
    assert "empty sentence" in refusal(cache, "lorel", "--instruction", "\u200b")
    wrong = refusal(tmp_path / "no", "lorel", "--instruction", "open teh drawer")
    assert "lads_exporter language" in wrong and "open drawer" in wrong and str(tmp_path / "no") in wrong
    assert "lads_exporter language" in refusal(tmp_path / "no", "lorel", "--encode-language")
    assert "open drawer, close drawer" in refusal(cache, "lorel", "--instruction", "pull the drawer out", "--sub-tasks", "shut it")
    other = tmp_path / "other"
    other.mkdir()
    for file in ("encoder.onnx", "tokenizer.json"):
        (other / file).symlink_to(cache / "language" / language.DEFAULT / file)
    manifest = json.loads((cache / "language" / language.DEFAULT / "manifest.json").read_text())
    (other / "manifest.json").write_text(json.dumps(manifest | {"sha256": "0123456789abcdef" * 4}))
    wrong = refusal(cache, "lorel", "--instruction", "shut it", "--encoder", other)
    assert "0123456789ab" in wrong and manifest["sha256"][:12] in wrong
