"""Every form of policy file of the field (`forms.py`) through the compiler and `lads act`, beside ONNX Runtime: 200 steps with resets.

Each file is put into a bundle of the `plain` family here, as a person would who knows its states and limits. Run with
`python -m pytest tests/parity` in the exporter's environment, after `cargo build -p lads-cli`. Skipped where either is missing.
"""

import base64
import json
import os
import pathlib
import subprocess

import pytest

np = pytest.importorskip("numpy")
onnx = pytest.importorskip("onnx")
ort = pytest.importorskip("onnxruntime")
contracts = pytest.importorskip("lads_exporter.contract")
import forms  # noqa: E402
from onnx import TensorProto, helper  # noqa: E402
from safetensors.numpy import save  # noqa: E402

ROOT = pathlib.Path(__file__).resolve().parents[2]
TARGET = pathlib.Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
ENTRY = "policy/act"
STEPS, RESETS = 200, (67, 150)
# Of numbers of 16 bits ONNX Runtime rounds every one; the compiler computes with 32.
TOLERANCES = {"float16": 5e-3}
TOLERANCE = 1e-5


def tolerance(form):
    return next((bound for kind, bound in TOLERANCES.items() if form.name.startswith(kind)), TOLERANCE)


def lads():
    builds = [p for p in (TARGET / profile / "lads" for profile in ("release", "debug")) if p.is_file()]
    if not builds:
        pytest.skip("lads is not built: run `cargo build -p lads-cli`")
    return max(builds, key=lambda path: path.stat().st_mtime)


def shape(value):
    """Symbolic axes are meant to be 1."""
    return [dim.dim_value or 1 for dim in value.type.tensor_type.shape.dim]


def inputs(form):
    known = {tensor.name for tensor in form.model.graph.initializer}
    return [value for value in form.model.graph.input if value.name not in known]


def session(form):
    options = ort.SessionOptions()
    options.log_severity_level = 4
    return ort.InferenceSession(form.model.SerializeToString(), options, providers=["CPUExecutionProvider"])


def episode(form):
    """-> {channel: [T, n]}, actions [T, m] of ONNX Runtime, states cleared at `RESETS`."""
    random = np.random.default_rng(3)
    channels = {}
    for value in inputs(form):
        if value.name not in form.states:
            low, high = form.limits.get(value.name, (-3, 3))
            count = int(np.prod(shape(value)))
            truth = value.type.tensor_type.elem_type == TensorProto.BOOL
            drawn = random.integers(0, 2, (STEPS, count)) if truth else random.uniform(low, high, (STEPS, count))
            channels[value.name] = drawn.astype(np.uint8 if truth else np.float32)
    run, kinds = session(form), {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(double)": np.float64, "tensor(bool)": bool}
    wanted = [form.action, *form.states.values()]
    shapes = {value.name: shape(value) for value in inputs(form)}
    actions, states = [], {}
    for t in range(STEPS):
        if t == 0 or t in RESETS:
            states = {name: np.zeros(shapes[name], np.float32) for name in form.states}
        given = {port.name: (channels[port.name][t].reshape(shapes[port.name]) if port.name in channels else states[port.name]).astype(kinds[port.type]) for port in run.get_inputs()}
        action, *after = run.run(wanted, given)
        states = dict(zip(form.states, after, strict=True))
        actions.append(action.astype(np.float32).ravel())
    return channels, np.stack(actions)


def bundle(form, channels, actions):
    """The form as a bundle; its golden episode is up to the first reset."""
    model = onnx.ModelProto()
    model.CopyFrom(form.model)
    graph = model.graph
    names = {name: f"{ENTRY}/{name}" for name in [*channels, *form.states]}
    names |= {after: f"{ENTRY}/next_{name}" for name, after in form.states.items()} | {form.action: f"{ENTRY}/action"}
    keep = [value for value in graph.output if value.name in names]
    del graph.output[:]
    graph.output.extend(keep)
    for value in [*graph.input, *graph.output]:
        value.name = names.get(value.name, value.name)
        for dim, size in zip(value.type.tensor_type.shape.dim, shape(value), strict=True):
            dim.dim_value = size
    for node in graph.node:
        node.input[:] = [names.get(name, name) for name in node.input]
        node.output[:] = [names.get(name, name) for name in node.output]
    observed = []
    for name, rows in channels.items():
        if rows.dtype == np.uint8:
            observed.append(contracts.array(name, "observation", [rows.shape[1]], "u8", min=0, max=1))
        else:
            low, high = form.limits.get(name, (-3, 3))
            elements = [{"name": f"{name}.{i}", "unit": "1", "min": low, "max": high} for i in range(rows.shape[1])]
            observed.append(contracts.vector(name, "observation", elements))
    acted = [{"name": f"joint{i}", "unit": "rad", "min": -1e4, "max": 1e4} for i in range(actions.shape[1])]
    found = {
        "version": contracts.VERSION,
        "family": {"kind": "plain"},
        "environment": {"id": form.name, "version": "1"},
        "control_period_s": 0.02,
        "channels": [*observed, contracts.vector("action", "action", acted, reference="position")],
        "provenance": {},
    }
    widths = {value.name.removeprefix(f"{ENTRY}/"): shape(value) for value in graph.input}
    states = [{"name": name, "shape": widths[name], "kind": "plain", "cleared_by": "episode"} for name in form.states]
    if states:
        found["states"] = states
    first = {f"channel.{name}": rows[: RESETS[0]] for name, rows in channels.items()} | {"actions": actions[: RESETS[0]]}
    golden = save({name: np.ascontiguousarray(rows) for name, rows in first.items()}, metadata={"tolerance": str(10 * tolerance(form))})
    helper.set_model_props(model, {contracts.KEY: json.dumps(found), contracts.GOLDEN_KEY: base64.b64encode(golden).decode()})
    return model


def act(path, channels):
    """-> actions [T, m] of the runtime."""
    lines = []
    for t in range(STEPS):
        if t in RESETS:
            lines.append("")
        lines.append(json.dumps([float(x) for rows in channels.values() for x in rows[t]]))
    done = subprocess.run([lads(), "act", "--model", path], input="\n".join(lines) + "\n", capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return np.array([json.loads(line) for line in done.stdout.splitlines() if line], np.float32)


def compare(form, folder):
    """-> the largest difference from ONNX Runtime, relative to numbers above one."""
    channels, expected = episode(form)
    path = folder / f"{form.name}.onnx"
    onnx.save(bundle(form, channels, expected), path)
    got = act(path, channels)
    assert got.shape == expected.shape
    assert np.abs(expected).max() > 1e-3, "the policy does something"
    return float((np.abs(got - expected) / np.maximum(1, np.abs(expected))).max())


def test_every_form(tmp_path):
    lads()
    wrong, left, worst = [], [], {}
    for form in forms.forms():
        try:
            worst[form.name] = compare(form, tmp_path)
        except AssertionError as error:
            if "operator Conv is not supported" in str(error):
                left.append(form.name)
            else:
                wrong.append(f"{form.name}: {error}"[:400])
            continue
        if not worst[form.name] <= tolerance(form):
            wrong.append(f"{form.name}: differs by {worst[form.name]:.1e}")
    print(f"{len(worst)} forms, largest difference {max(worst.values()):.1e}; without convolutions: {left}")
    assert not wrong, "\n".join(wrong)
