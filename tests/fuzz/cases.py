"""Writes the cases of `corpus/import`: small policies of the forms that public repositories have, and the files that come with them.

    python tests/fuzz/cases.py tests/fuzz/corpus/import

A case is what `tests/src/hostile/import.rs` says: edits, options, description, deploy.yaml, manifest.json, recorded run and policy.
"""

import copy
import pathlib
import sys

import onnx

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent / "parity"))
import forms  # noqa: E402
from test_import import described  # noqa: E402

BREAK = b"\n----\n"
FORMS = (
    "mlp-elu-11", "rank-one-13", "batch-17", "normalizer-div-18", "gru-13", "lstm-18", "gru-cell-is-init-13", "conv1d-17", "layer-norm-18",
    "motion-18", "einsum-18", "folded-13", "swish-split-11", "sequence", "old-7", "constants", "float64-edges", "float16-weights",
)  # fmt: skip

DEPLOY = """joint_ids_map: [1, 0, 3, 2]
step_dt: 0.02
stiffness: [10, 20, 30, 40]
damping: [1.0, 1.5, 2.0, 2.5]
default_joint_pos: [0.5, 0.6, 0.7, 0.8]
commands: {base_velocity: {ranges: {lin_vel_x: [-1, 1], lin_vel_y: [-0.5, 0.5], heading: null}}}
actions: {JointPositionAction: {scale: [0.25, 0.25, 0.5, 0.5], offset: [0.5, 0.6, 0.7, 0.8], clip: [[-1, 1], [-2, 2], [-1, 1], [-1, 1]]}}
observations:
  velocity_commands: {scale: [1.0, 1.0], clip: null, history_length: 1, params: {command_name: base_velocity}}
  joint_pos_rel: {scale: 1.0, clip: [-3, 3], history_length: 2, params: {asset_cfg: !!python/object/apply:builtins.slice [0, 4]}}
  alone: {scale: [2.0, 0.5], clip: [-.inf, .inf], history_length: 1}
"""
MANIFEST = """{"joint_names": ["a", "b", "c", "d"], "kp": {"a": 1.5, "b": 2, "c": 3, "d": 4}, "kd": [0.5, 0.5, 0.5, 0.5], "action_scale": 0.25,
"default_joint_pos": [0, 0.1, 0.2, 0.3], "control_dt": 0.02, "observation_names": ["base_ang_vel", "projected_gravity", "joint_pos"]}
"""
METADATA = {
    "run_path": "logs/run", "joint_names": "a,b,c,d", "joint_stiffness": "0.000,0.000,1.000,2.000", "joint_damping": "0.5,0.25,1.0,1.0",
    "default_joint_pos": "0.100,-0.200,0.000,0.000", "observation_names": "base_ang_vel,projected_gravity,joint_pos,alone", "action_scale": "0.25",
    "observation_terms_scale": "0.25,1.0,[1.0;2.0;1.0;1.0],1.0", "observation_terms_clip": "-1.0;1.0,-inf;inf,-2.0;2.0,None",
    "observation_terms_history_length": "0,0,1,0", "command_ranges": '{"x": [-1, 1]}',
}  # fmt: skip
# Every source and every list of a description, for a policy of 12 observations and 4 actions.
ROBOT = """environment = { id = "form", version = "1" }
control_period_s = 0.02
joints = ["a", "b", "c", "d"]
robot_joints = ["d", "c", "b", "a"]
quaternion_order = "xyzw"
[[term]]
name = "projected_gravity"
from = "gravity"
[[term]]
name = "clock"
from = "phase"
phase = { period_s = 0.8, elements = [{ of = "sin" }, { of = "cos", ahead = 0.5 }] }
[[term]]
name = "last_action"
clip = [-1, 1]
[[term]]
name = "count"
from = "step"
scale = 0.01
[[term]]
name = "begins"
from = "first"
[[term]]
name = "alone"
width = 1
unit = "m"
min = -1
max = 1
channel = "height"
offset = 0.25
clip = [[-1], [2]]
[action]
interface = "position"
unit = "rad"
scale = [0.25, 0.25, 0.5, 0.5]
offset = 0
min = -1
max = [1, 1, 2, 2]
clip = 5
stiffness = 20
damping = [0.5, 0.5, 0.5, 0.5]
tolerance = 1e-3
"""
HISTORY = """environment = { id = "form", version = "1" }
control_period_s = 0.02
history = { length = 3, layout = "term", order = "newest_first", start = "zero" }
term = [{ name = "a", width = 3, unit = "1", min = -1, max = 1 }, { name = "b", width = 1, unit = "1", min = [-1], max = 1, scale = 2 }]
action = { elements = ["p", "q", "r", "s"], unit = "1", scale = 1, offset = 0, min = -100, max = 100 }
"""


def case(policy, options="", robot="", deploy="", manifest="", recording=""):
    texts = [part.encode() for part in (options, robot, deploy, manifest, recording)]
    return BREAK.join([b"", *texts, policy])


def cases():
    """Yields all cases: (name, bytes)."""
    known = {form.name: form for form in forms.forms(FORMS.__contains__)}
    assert set(known) == set(FORMS)
    for name, form in known.items():
        yield name, case(form.model.SerializeToString(), robot=described(form, forms.M))
    small = known["mlp-elu-11"].model
    policy = small.SerializeToString()
    yield "sources", case(policy, robot=ROBOT)
    yield "history", case(policy, robot=HISTORY)
    yield "deploy", case(policy, robot="action = {}\n", deploy=DEPLOY)
    yield "manifest", case(policy, manifest=MANIFEST)
    said = copy.deepcopy(small)
    onnx.helper.set_model_props(said, METADATA)
    yield "metadata", case(said.SerializeToString())
    columns = [f"observation.v0_{i}" for i in range(forms.N)] + [f"action.a{i}" for i in range(forms.M)]
    run = ",".join([*columns, "reset"]) + "\n" + (",".join(["0.5"] * (forms.N + forms.M)) + ",0\n") * 3
    yield "recording", case(policy, robot=described(known["mlp-elu-11"], forms.M), recording=run)
    wired = HISTORY.replace("history =", "# history =") + 'state = []\n'
    yield "files", case(policy, "twice\nwire policy:actions=second:obs\naction actions\n", wired)
    yield "biped", case(b"", robot=(pathlib.Path(__file__).parents[2] / "runtime/host/examples/biped/robot.toml").read_text())


if __name__ == "__main__":
    folder = pathlib.Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in cases():
        (folder / name).write_bytes(content)
