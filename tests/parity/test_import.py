"""Tests every form of policy file that public repositories have, imported with `lads import` and stepped with `lads act`, beside ONNX
Runtime.

The files are made by `forms.py`. ONNX Runtime runs the file as it is, its states fed back by hand; the runtime has only the bundle and raw
values. 200 steps with resets. Skipped where ONNX Runtime or cargo is missing.

    python tests/parity/test_import.py FOLDER

writes all forms and what a person says of each, for the edits of `runtime/import/tests/hostile.rs`.
"""

import pathlib
import subprocess
import sys

import pytest

np = pytest.importorskip("numpy")
onnx = pytest.importorskip("onnx")
ort = pytest.importorskip("onnxruntime")
pytest.importorskip("torch")

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent))
import forms  # noqa: E402
from programs import built  # noqa: E402

# The Makefile's: with another one cargo would build its dependencies once more.
STEPS, RESETS = 200, (70, 140)
# Inputs that say that an episode begins.
BEGINS = ("is_init",)


@pytest.fixture(scope="module")
def lads():
    """Builds the command `lads` -> its path."""
    return built("lads")


def inputs(form):
    """Lists all inputs that are not weights -> (name, shape with batches of one, numpy type)."""
    weights = {tensor.name for tensor in form.model.graph.initializer}
    for value in form.model.graph.input:
        if value.name not in weights:
            tensor = value.type.tensor_type
            shape = [dim.dim_value or 1 for dim in tensor.shape.dim]
            yield value.name, shape, onnx.helper.tensor_dtype_to_np_dtype(tensor.elem_type)


def described(form, width):
    """Returns a person's description of the file: as little as is needed."""
    terms = []
    for number, (name, shape, _) in enumerate(inputs(form)):
        if name in form.states:
            continue
        low, high = form.limits.get(name, (-3.0, 3.0))
        term = f'[[term]]\nname = "v{number}"\ninput = "{name}"\nwidth = {int(np.prod(shape))}\n'
        if name in BEGINS:
            terms.append(term.replace(f"width = {int(np.prod(shape))}", 'from = "first"'))
        else:
            terms.append(term + f'unit = "1"\nmin = {low - 0.01}\nmax = {high + 0.01}\n')
    states = [f'[[state]]\ninput = "{given}"\noutput = "{made}"\n' for given, made in form.states.items()]
    names = ", ".join(f'"a{i}"' for i in range(width))
    action = f'[action]\noutput = "{form.action}"\nelements = [{names}]\nunit = "1"\nscale = 1\noffset = 0\nmin = -10000\nmax = 10000\ntolerance = 1e-4\n'
    return 'environment = { id = "form", version = "1" }\ncontrol_period_s = 0.02\n' + "\n".join([*terms, *states, action])


def stepped(session, form, rows):
    """Runs ONNX Runtime: rows {input: [STEPS, ...]} -> actions [STEPS, A]."""
    shapes = {name: (shape, kind) for name, shape, kind in inputs(form)}
    outputs = [value.name for value in session.get_outputs()]
    actions = []
    for step in range(STEPS):
        if step == 0 or step in RESETS:
            states = {name: np.zeros(*shapes[name]) for name in form.states}
        fed = {name: values[step].reshape(shapes[name][0]).astype(shapes[name][1]) for name, values in rows.items()}
        fed |= {name: np.full(*shapes[name][:1], step == 0 or step in RESETS, shapes[name][1]) for name in BEGINS if name in shapes}
        made = dict(zip(outputs, session.run(None, fed | states), strict=True))
        states = {given: made[output] for given, output in form.states.items()}
        actions.append(made[form.action].ravel().astype(np.float64))
    return np.array(actions)


def test_every_form_is_imported_and_does_what_onnx_runtime_does(lads, tmp_path):
    random, failed, count = np.random.default_rng(3), [], 0
    for form in forms.forms():
        path = tmp_path / f"{form.name}.onnx"
        onnx.save(form.model, path)
        session = ort.InferenceSession(form.model.SerializeToString(), providers=["CPUExecutionProvider"])
        rows = {}
        for name, shape, kind in inputs(form):
            if name not in form.states and name not in BEGINS:
                low, high = form.limits.get(name, (-3.0, 3.0))
                drawn = random.uniform(low, high, (STEPS, int(np.prod(shape))))
                rows[name] = np.floor(drawn) if np.issubdtype(kind, np.integer) or name in form.limits else drawn.astype(np.float32)
        wanted = stepped(session, form, rows)
        robot = tmp_path / "robot.toml"
        robot.write_text(described(form, wanted.shape[1]))
        bundle = tmp_path / f"{form.name}.lads.onnx"
        made = subprocess.run([lads, "import", path, "--contract", robot, "-o", bundle], capture_output=True, text=True)
        if made.returncode:
            failed.append(f"{form.name}: {made.stderr.strip()}")
            continue
        # All channels in one line; an empty one starts an episode.
        lines = [",".join(repr(float(np.float32(value))) for values in rows.values() for value in values[step].ravel()) for step in range(STEPS)]
        text = "".join(("\n" if step in RESETS else "") + line + "\n" for step, line in enumerate(lines))
        acted = subprocess.run([lads, "act", "--model", bundle], input=text, capture_output=True, text=True)
        got = np.array([[float(part) for part in line.split(",")] for line in acted.stdout.split("\n") if line])
        if acted.returncode or got.shape != wanted.shape:
            failed.append(f"{form.name}: {got.shape} {acted.stderr.strip()}")
            continue
        # Half precision is computed in single here, and rounds in ONNX Runtime.
        bound = 2e-2 if "half" in form.name or "float16" in form.name else 1e-5
        difference = np.abs(got - wanted).max() / max(1.0, np.abs(wanted).max())
        if not difference <= bound:
            failed.append(f"{form.name}: off by {difference:.2e}")
        count += 1
    print(f"{count} forms agree")
    assert not failed, "\n".join(failed)
    assert count > 60


BIPED = pathlib.Path(__file__).resolve().parents[2] / "runtime/host/examples/biped"


def test_an_output_is_nothing_that_was_read(lads, tmp_path):
    """Tests that external weights and neighbours are not written over, which nobody names on the command line."""
    model, weights, neighbour = tmp_path / "stand.onnx", tmp_path / "stand.bin", tmp_path / "manifest.json"
    onnx.save(onnx.load(BIPED / "stand.onnx"), model, save_as_external_data=True, location="stand.bin", size_threshold=16)
    neighbour.write_text("{}")
    for read in (weights, neighbour):
        before = read.read_bytes()
        done = subprocess.run([lads, "import", model, "--contract", BIPED / "robot.toml", "-o", read], capture_output=True, text=True)
        assert done.returncode == 2 and "-o" in done.stderr and len(done.stderr.splitlines()) == 1, done.stderr
        assert read.read_bytes() == before


def test_a_recording_is_a_file_that_ends(lads, tmp_path):
    command = [lads, "import", BIPED / "stand.onnx", "--contract", BIPED / "robot.toml", "--golden", "/dev/zero", "-o", tmp_path / "out.onnx"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and "/dev/zero" in done.stderr, done.stderr
    assert not (tmp_path / "out.onnx").exists()


if __name__ == "__main__":
    folder = pathlib.Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for form in forms.forms():
        onnx.save(form.model, folder / f"{form.name}.onnx")
        action = next(value for value in form.model.graph.output if value.name == form.action)
        width = int(np.prod([dim.dim_value or 1 for dim in action.type.tensor_type.shape.dim]))
        (folder / f"{form.name}.toml").write_text(described(form, width))
