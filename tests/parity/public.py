"""Tries the policy files of folders, as copies of public repositories: each is imported, and 200 random steps are compared with ONNX Runtime.

    python tests/parity/public.py lads FOLDER...

prints a row of a table for each file. Every input that is no state is one term of raw values from -3 to 3, an input named like time from 0
to 200, so what is tried is the graph, not the description of a robot: metadata and the files beside a policy are left out.
"""

import pathlib
import subprocess
import sys
import tempfile

import numpy as np
import onnx
import onnxruntime as ort

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent))
from forms import Form  # noqa: E402
from test_import import BEGINS, STEPS, described, inputs, stepped  # noqa: E402

# Inputs that are the last step's outputs, under the names that exporters use.
STATES = {"h_in": "h_out", "c_in": "c_out", "adapt_hx": "next_adapt_hx", "hidden_in": "hidden_out", "hx_in": "hx_out", "in_hidden": "out_hidden"}
ACTIONS = ("actions", "action", "continuous_actions", "output", "mlp_output", "nn_output")
COUNTED = ("time_step", "timestep")


def form_of(path):
    """Returns the form of a file: the action by its usual name, else the first output."""
    model = onnx.load(path)
    del model.metadata_props[:]
    given = {value.name for value in model.graph.input}
    made = [value.name for value in model.graph.output]
    states = {name: output for name, output in STATES.items() if name in given and output in made}
    action = next((name for name in ACTIONS if name in made), next(name for name in made if name not in states.values()))
    return Form(path.stem, model, action, states, {name: (0, 200) for name in COUNTED if name in given})


def compared(lads, form, folder):
    """Imports a form and steps it beside ONNX Runtime -> (largest difference, largest action)."""
    session = ort.InferenceSession(form.model.SerializeToString(), providers=["CPUExecutionProvider"])
    random, rows = np.random.default_rng(3), {}
    for name, shape, _ in inputs(form):
        if name not in form.states and name not in BEGINS:
            drawn = random.uniform(*form.limits.get(name, (-3.0, 3.0)), (STEPS, int(np.prod(shape))))
            rows[name] = np.floor(drawn) if name in form.limits else drawn.astype(np.float32)
    wanted = stepped(session, form, rows)
    policy, robot, bundle = folder / "policy.onnx", folder / "robot.toml", folder / "policy.lads.onnx"
    onnx.save(form.model, policy)
    robot.write_text(described(form, wanted.shape[1]).replace("tolerance = 1e-4", ""))
    made = subprocess.run([lads, "import", policy, "--contract", robot, "-o", bundle], capture_output=True, text=True)
    if made.returncode:
        raise ValueError("; ".join(line.strip() for line in made.stderr.splitlines()).replace(str(folder) + "/", ""))
    lines = []
    for step in range(STEPS):
        # An empty line starts an episode.
        lines += [""] * (step in (70, 140))
        lines.append(",".join(repr(float(np.float32(value))) for values in rows.values() for value in values[step].ravel()))
    acted = subprocess.run([lads, "act", "--model", bundle], input="\n".join(lines) + "\n", capture_output=True, text=True)
    if acted.returncode:
        raise ValueError(acted.stderr.strip().replace(str(folder) + "/", ""))
    got = np.array([[float(part) for part in line.split(",")] for line in acted.stdout.split("\n") if line])
    return np.abs(got - wanted).max(), np.abs(wanted).max()


def row(lads, path, shown):
    try:
        form = form_of(path)
        shape = " + ".join(f"{int(np.prod(shape))}" for _, shape, _ in inputs(form))
        opset = next(one.version for one in form.model.opset_import if one.domain in ("", "ai.onnx"))
        about = f"{shape} | {opset} {form.model.producer_name}"
    except Exception as error:  # Whatever a file of somebody else does is a row, not the end.
        return f"| {shown} | | | no model: {str(error).splitlines()[0][:80]} |"
    try:
        with tempfile.TemporaryDirectory() as folder:
            difference, largest = compared(lads, form, pathlib.Path(folder))
        return f"| {shown} | {about} | {difference:.1e} of {largest:.2g} |"
    except Exception as error:
        return f"| {shown} | {about} | refused: {str(error)[:300]} |"


if __name__ == "__main__":
    program, *folders = sys.argv[1:]
    print("| file | inputs | opset, producer | largest difference, of the largest action |\n|---|---|---|---|")
    for base in map(pathlib.Path, folders):
        for path in sorted(base.rglob("*.onnx")):
            print(row(program, path, f"{base.name}: {path.relative_to(base)}"), flush=True)
