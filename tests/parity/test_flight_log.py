"""Tests that others can read a flight log: MCAP's own reader with its checksums, and a JSON Schema validator, which know nothing of lads.

Run with `python -m pytest tests/parity` in the exporter's environment, after `cargo build -p lads-sim`. Skipped where either is missing.
"""

import collections
import json
import subprocess

import pytest
from programs import ROOT, newest

reader = pytest.importorskip("mcap.reader")
jsonschema = pytest.importorskip("jsonschema")

# Of every control step.
STEPS = ("/observation", "/action", "/plan", "/timing", "/gripper")


@pytest.fixture(params=[("kitchen", "kbls"), ("lorel", "open drawer")], ids=lambda case: case[0])
def flight(request, tmp_path):
    """Records a flight -> the results, the log."""
    model, instruction = request.param
    log, results = tmp_path / "flight.mcap", tmp_path / "results.json"
    command = [newest("lads-run"), "--model", ROOT / f"models/{model}.onnx", "--instruction", instruction, "--episodes", "2"]
    done = subprocess.run([*command, "--log", log, "--json", results], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(results.read_text()), log


def test_a_log_is_what_mcap_and_json_schema_say(flight):
    results, log = flight
    (instruction,) = results["instructions"]
    runs = instruction["runs"]
    count, times = collections.Counter(), collections.defaultdict(list)
    plans, completed = [], []
    with log.open("rb") as file:
        source = reader.make_reader(file, validate_crcs=True)
        for schema, channel, message in source.iter_messages(log_time_order=False):
            # What Foxglove asks of JSON: a schema of an object, and arrays whose items have one type.
            assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
            rules, value = json.loads(schema.data), json.loads(message.data)
            jsonschema.Draft7Validator.check_schema(rules)
            assert rules["type"] == "object" and schema.name.startswith("lads.")
            for field in rules["properties"].values():
                assert field["description"] and (field["type"] != "array" or isinstance(field["items"], dict))
            # May be missing: the words of an instruction in the table, the noise of a policy that draws none, random draws that begin anew.
            required = [name for name in rules["properties"] if name not in ("words", "noise_seed", "continued")]
            jsonschema.validate(value, rules | {"additionalProperties": False, "required": required})
            count[channel.topic] += 1
            times[channel.topic].append(message.log_time)
            if channel.topic == "/plan" and value["decided"]:
                plans.append(value["index"])
            if channel.topic == "/completion":
                completed.append(value["sub_task"])
        statistics = source.get_summary().statistics
        about = {entry.name: entry.metadata for entry in source.iter_metadata()}["lads"]
    assert statistics.message_count == sum(count.values())
    steps = sum(run["steps"] for run in runs)
    assert {topic: count[topic] for topic in STEPS} == dict.fromkeys(STEPS, steps)
    assert count["/episode"] == len(runs) == 2
    assert plans == [plan for run in runs for plan in run["plans"]] and count["/logits"] == len(plans)
    assert completed == [done["sub_task"] for run in runs for done in run["completions"]]
    assert all(row == sorted(row) for row in times.values()), "time goes on"
    # A player shows the episode as fast as it was.
    period = float(about["control_period_s"])
    first = [later - earlier for earlier, later in zip(times["/action"], times["/action"][1:], strict=False)][: runs[0]["steps"] - 1]
    assert all(abs(gap / 1e9 - period) < 1e-6 for gap in first)
    assert about["bundle_sha256"] == results["bundle_sha256"]


@pytest.mark.parametrize("kind", ["lads", "vae", "lcsd", "recurrent", "camera", "sighted_history"])
def test_a_log_of_act_replays(kind, tmp_path):
    """Tests that what `lads act` records, two episodes of one command, is computed again bit for bit: states, draws and frames too."""
    kinds, bundle = pytest.importorskip("lads_exporter.kinds"), pytest.importorskip("lads_exporter.bundle")
    _, model = kinds.export(kind, seed=0)
    policy, log = tmp_path / "policy.onnx", tmp_path / "flight.mcap"
    bundle.save(model, policy)
    run = lambda *command, **more: subprocess.run(command, capture_output=True, text=True, timeout=300, **more)
    seen = run(newest("lads"), "inspect", policy, "--observations").stdout
    instruction = ["--instruction", "open"] if "instructions" in kinds.KINDS[kind].contract(kinds.KINDS[kind].sizes, 0) else []
    acted = run(newest("lads"), "act", "--model", policy, *instruction, "--log", log, input=f"{seen}\n{seen}")
    assert acted.returncode == 0, acted.stderr
    replayed = run(newest("lads-run"), "replay", "--model", policy, log)
    assert replayed.returncode == 0, replayed.stdout + replayed.stderr
    assert f"{2 * len(seen.splitlines())}" in replayed.stdout and "2 episodes" in replayed.stdout, replayed.stdout
    # And a log of other numbers does not.
    other = run(newest("lads-run"), "replay", "--model", _of_another_seed(kind, tmp_path), log)
    assert other.returncode == 1, other.stdout + other.stderr


def test_a_log_without_steps_is_not_called_equal(tmp_path):
    log, kitchen = tmp_path / "flight.mcap", ROOT / "models/kitchen-small.onnx"
    acted = subprocess.run([newest("lads"), "act", "--model", kitchen, "--instruction", "mkbh", "--log", log], input="", text=True, timeout=300)
    assert acted.returncode == 0
    replayed = subprocess.run([newest("lads-run"), "replay", "--model", kitchen, log], capture_output=True, text=True, timeout=300)
    assert replayed.returncode == 2 and "no control step" in replayed.stderr and replayed.stdout == ""


def _of_another_seed(kind, folder):
    from lads_exporter import bundle, kinds

    path = folder / "other.onnx"
    bundle.save(kinds.export(kind, seed=1)[1], path)
    return path
