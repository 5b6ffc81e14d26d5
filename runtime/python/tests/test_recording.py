"""Recordings, read by the MCAP project's own library."""

import json

import numpy as np
import pytest

import environments
import lads


def test_a_recording_holds_what_happened(kitchen, tmp_path):
    reader = pytest.importorskip("mcap.reader")
    rows = kitchen.golden.observations["observation"]
    controller = kitchen.controller("kbls")
    path = tmp_path / "flight.mcap"
    expected = []
    with lads.Recorder(controller, path, seed=3, notes={"robot": "none"}) as recorder:
        for row in rows[:12]:
            action, report = recorder.step(row)
            recorder.executed(action * np.float32(0.5))
            expected.append((row, action, report))
        recorder.end(success=True, completions=[("kettle", 5)])
        recorder.instruct("mbts")
        recorder.step(rows[0])
        assert not path.exists(), "nothing is half-written"
    found = {}
    with path.open("rb") as file:
        opened = reader.make_reader(file)
        (metadata,) = [row.metadata for row in opened.iter_metadata()]
        for _, channel, message in opened.iter_messages():
            found.setdefault(channel.topic, []).append(json.loads(message.data))
    assert metadata["bundle_sha256"] == kitchen.contract.bundle_sha256 and metadata["seed"] == "3" and metadata["note.robot"] == "none"
    assert [(row["instruction_id"], row["steps"], row["success"]) for row in found["/episode"]] == [("kbls", 12, True), ("mbts", 1, False)]
    assert found["/completion"] == [{"sub_task": "kettle", "step": 5}]
    for (row, action, report), seen, done, plan in zip(expected, found["/observation"], found["/action"], found["/plan"]):
        assert np.array_equal(np.float32(seen["values"]), row) and np.array_equal(np.float32(done["policy"]), action)
        assert np.array_equal(np.float32(done["executed"]), action * np.float32(0.5))
        assert plan["index"] == report.selected.index and plan["decided"] == report.selected.fresh
    decisions = sum(report.selected.fresh for *_, report in expected) + 1
    assert len(found["/logits"]) == decisions and len(found["/timing"]) == 13


def test_it_drives_an_environment(plain, tmp_path):
    with lads.Recorder(plain.controller(), tmp_path / "servo.mcap") as recorder:
        policy = lads.gym.Policy(recorder)
        environment = environments.Servo()
        for seed in range(2):
            policy.reset()
            observation, _ = environment.reset(seed=seed)
            for _ in range(5):
                observation, *_ = environment.step(policy(observation))
    assert (tmp_path / "servo.mcap").stat().st_size > 1000


def test_what_cannot_be_recorded_is_named(bundles, plain, seen, tmp_path):
    camera = lads.open(bundles["camera"])
    with pytest.raises(lads.errors.RecordError, match="the policy observes `observation`, `camera`, `mode`; a recording holds one channel"):
        lads.Recorder(camera.controller(), tmp_path / "a.mcap")
    with pytest.raises(lads.errors.RecordError, match="nowhere/a.mcap: it cannot be written"):
        with lads.Recorder(plain.controller(), tmp_path / "nowhere/a.mcap") as recorder:
            recorder.step(seen)
    with pytest.raises(ZeroDivisionError):
        with lads.Recorder(plain.controller(), tmp_path / "b.mcap") as recorder:
            recorder.step(seen)
            1 / 0
    assert not (tmp_path / "b.mcap").exists()
