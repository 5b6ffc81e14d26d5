"""Tests which free sentences are followed: the measure, the threshold, the shipped calibrations, and how they get into a contract."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lads_exporter import acceptance, card, config
from lads_exporter.config import UserError

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = {"kitchen": "kitchen", "kitchen-small": "kitchen", "lorel": "lorel"}


def shipped(name):
    setting = config.load(f"configs/{name}.toml")
    rows = acceptance.read_sentences(ROOT / f"exporter/configs/{SHIPPED[name]}.sentences.json", setting)
    return setting, rows, acceptance.read(ROOT / f"models/{name}.acceptance.json")


def test_alignment_is_the_mean_of_the_best_cosines_without_the_end_mark():
    x, y = np.array([2, 0], np.float32), np.array([0, 3], np.float32)
    end = np.array([9, 9], np.float32)
    assert acceptance.alignment(np.stack([x, y, end]), np.stack([y, x, end])) == pytest.approx(1)
    assert acceptance.alignment(np.stack([x, y, end]), np.stack([x, end])) == pytest.approx(0.5)
    assert acceptance.alignment(x[None], np.stack([x + y / 1.5, end])) == pytest.approx(0.5**0.5), "one word is not an end mark"
    assert acceptance.alignment(-x[None], x[None]) == pytest.approx(-1)
    assert acceptance.alignment(np.zeros((1, 2)), x[None]) == 0
    assert acceptance.nearest(x[None], [y[None], x[None], 2 * x[None]]) == (1, pytest.approx(1))


def test_the_threshold_parts_known_from_other():
    assert acceptance.best_threshold([0.1, 0.2, 0.8, 0.9], [False, False, True, True]) == 0.5
    assert acceptance.best_threshold([0.1, 0.6, 0.5, 0.9], [False, False, True, True]) == 0.75, "of equal ones the strictest"


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_calibrations_follow_from_their_similarities(name):
    setting, rows, calibrated = shipped(name)
    kept = calibrated["sentences"]
    assert [(row["known"], row["kind"], row["text"]) for row in kept] == [(row.known, row.kind, row.text) for row in rows]
    for key, value in acceptance.summary(rows, [row["similarity"] for row in kept]).items():
        assert calibrated[key] == value, key
    assert sum(row.known for row in rows) >= 40 and sum(not row.known for row in rows) >= 40
    chosen = calibrated["acceptance"]
    assert chosen["accepted_known"] >= 0.8 and chosen["accepted_other"] <= 0.125, "it parts them well enough to be of use"
    by_text = {row["text"]: row["similarity"] for row in kept}
    for text in ("asdf qwerty", "do nothing, stay where you are"):
        assert by_text[text] < chosen["threshold"], text


@pytest.mark.parametrize("name", SHIPPED)
def test_cards_say_what_was_calibrated(name):
    calibrated = acceptance.read(ROOT / f"models/{name}.acceptance.json")
    assert "\n".join(card.free_sentences(calibrated)) in (ROOT / f"models/{name}.md").read_text()


@pytest.mark.parametrize("name", SHIPPED)
def test_a_bundle_takes_its_own_calibration_only(name):
    import onnx

    calibrated = acceptance.read(ROOT / f"models/{name}.acceptance.json")
    model = acceptance.into(onnx.load(ROOT / f"models/{name}.onnx"), calibrated)
    (contract,) = (json.loads(row.value) for row in model.metadata_props if row.key == "lads.contract")
    assert contract["language"]["acceptance"] == calibrated["acceptance"]
    assert acceptance.add(contract, calibrated) == contract, "again the same"
    other = {"kitchen": "lorel", "kitchen-small": "kitchen", "lorel": "kitchen-small"}[name]
    with pytest.raises(UserError, match="calibrate it anew"):
        acceptance.add(contract, acceptance.read(ROOT / f"models/{other}.acceptance.json"))
    with pytest.raises(UserError, match="calibrate it anew"):
        acceptance.add(contract | {"instructions": contract["instructions"][1:]}, calibrated)
    with pytest.raises(UserError, match=r"no lads\.contract"):
        acceptance.into(onnx.ModelProto(), calibrated)


def calibrate(tmp_path, sentences):
    """Runs the command on the small encoder of tests -> exit code, stdout, stderr, the file."""
    (tmp_path / "table.json").write_text(json.dumps(sentences))
    command = [sys.executable, "-m", "lads_exporter", "calibrate", "--config", "configs/tiny.toml"]
    command += ["--sentences", tmp_path / "table.json", "-o", tmp_path / "out.json"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT / "exporter")
    return done.returncode, done.stdout, done.stderr, tmp_path / "out.json"


def table():
    setting = config.load("configs/tiny.toml")
    texts = [row["text"] for row in setting.instructions]
    known = [{"known": True, "kind": "words", "text": f"{text} number{i}"} for text in texts for i in range(40)]
    other = [{"known": False, "kind": "nonsense", "text": f"gibberish{i} more{i}"} for i in range(40)]
    return {"environment": setting.environment["id"], "sentences": known + other}


def test_the_command_calibrates(tmp_path):
    code, out, wrong, file = calibrate(tmp_path, table())
    assert code == 0, wrong
    first = file.read_bytes()
    calibrated = acceptance.read(file)
    assert calibrated["acceptance"]["accepted_known"] == 1 and calibrated["acceptance"]["accepted_other"] == 0
    assert calibrated["held_out"]["accepted_known"] == 1 and f"of {calibrated['acceptance']['threshold']} to" in out
    calibrate(tmp_path, table())
    assert file.read_bytes() == first, "repeatable"


def test_bad_tables_are_refused(tmp_path):
    good = table()
    rows = good["sentences"]
    known = config.load("configs/tiny.toml").instructions[0]["text"]
    bad = {
        "sentences for kitchen": good | {"environment": "kitchen"},
        "stands there twice": good | {"sentences": [*rows, rows[0]]},
        "own table": good | {"sentences": [*rows, {"known": True, "kind": "words", "text": known.upper()}]},
        "39 sentences that are not known": good | {"sentences": rows[:-1]},
        "not a table": {"sentences": []},
    }
    for message, sentences in bad.items():
        code, out, wrong, file = calibrate(tmp_path, sentences)
        assert code == 2 and out == "" and len(wrong.splitlines()) == 1 and message in wrong, wrong
        assert not file.exists()
    (tmp_path / "no.json").write_text("{}")
    with pytest.raises(UserError, match="calibrate"):
        acceptance.read(tmp_path / "no.json")
