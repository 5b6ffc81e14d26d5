"""Recordings, read by the MCAP project's own library."""

import json

import numpy as np
import pytest
from mcap.reader import make_reader

import environments
import lads


def read(path):
    """Returns the messages by topic, and the metadata."""
    found = {}
    with path.open("rb") as file:
        opened = make_reader(file)
        (metadata,) = [row.metadata for row in opened.iter_metadata()]
        for _, channel, message in opened.iter_messages():
            found.setdefault(channel.topic, []).append(json.loads(message.data))
    return found, metadata


def test_a_recording_holds_what_happened(kitchen, tmp_path):
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
    found, metadata = read(path)
    assert json.loads(metadata["action_names"]) == [element.name for element in kitchen.contract.action.elements]
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
    seen, done = [], []
    with lads.Recorder(plain.controller(), tmp_path / "servo.mcap") as recorder:
        policy = lads.gym.Policy(recorder)
        environment = environments.Servo()
        for seed in range(2):
            policy.reset()
            observation, _ = environment.reset(seed=seed)
            for _ in range(5):
                seen.append(observation.astype(np.float32))
                done.append(policy(observation))
                observation, *_ = environment.step(done[-1])
    found, _ = read(tmp_path / "servo.mcap")
    assert [(row["episode"], row["steps"]) for row in found["/episode"]] == [(0, 5), (1, 5)]
    assert np.array_equal(np.float32([row["values"] for row in found["/observation"]]), seen)
    assert np.array_equal(np.float32([row["policy"] for row in found["/action"]]), done)


def test_what_is_recorded_is_the_observation_by_its_name(bundles, plain, seen, tmp_path):
    policy = lads.open(bundles["skilldiffuser"])
    golden = policy.golden
    given = {"noise": golden.noise[0], **{name: values[0] for name, values in golden.observations.items()}}
    recorder = lads.Recorder(policy.controller(golden.instruction), tmp_path / "a.mcap")
    with pytest.raises(lads.errors.RecordError, match="does not hold noise that is given"):
        recorder.step(given)
    shared = seen.copy()
    with lads.Recorder(plain.controller(), tmp_path / "b.mcap") as recorder:
        recorder.step({"observation": seen})
        recorder.step(shared, shared[:3])
        with pytest.raises(lads.errors.InputError, match="channel `observation` is not given"):
            recorder.step({})
    found, _ = read(tmp_path / "b.mcap")
    assert np.array_equal(np.float32([row["values"] for row in found["/observation"]]), [seen, seen])


def test_what_cannot_be_recorded_is_named(bundles, plain, seen, tmp_path):
    camera = lads.open(bundles["camera"])
    with pytest.raises(lads.errors.RecordError, match="the policy observes `observation`, `camera`, `mode`; a recording holds one channel"):
        lads.Recorder(camera.controller(), tmp_path / "a.mcap")
    with pytest.raises(lads.errors.RecordError, match="nowhere/a.mcap: cannot be written"):
        lads.Recorder(plain.controller(), tmp_path / "nowhere/a.mcap")
    with pytest.raises(lads.errors.RecordError, match="seed is -1; give 0 or more"):
        lads.Recorder(plain.controller(), tmp_path / "a.mcap", seed=-1)
    with pytest.raises(ZeroDivisionError):
        with lads.Recorder(plain.controller(), tmp_path / "b.mcap") as recorder:
            recorder.step(seen)
            1 / 0
    assert not (tmp_path / "b.mcap").exists()
