"""A table of tiny trainings, with a program in the place of lads-run that writes results of its form."""

import os
import shutil
import stat
import sys

import synthetic

from lads_exporter import config
from lads_exporter.tables import run

# Every episode of `lads-HASH.onnx` succeeds, of others one in four. Where MuJoCo is said to be missing, it ends as the loader does.
PROGRAM = """#!{python}
import hashlib, json, os, sys
if "WITHOUT_MUJOCO" in os.environ:
    sys.exit("lads-run: error while loading shared libraries: libmujoco.so: cannot open shared object file")
if "--version" in sys.argv:
    sys.exit()
sys.path.insert(0, "{source}")
from lads_exporter.tables import shards
options = dict(zip(sys.argv[1::2], sys.argv[2::2]))
lads = "/lads-" in options["--model"].removesuffix(".onnx")[-20:] and "--uniform" not in sys.argv
with open("{instructions}") as file:
    known = json.load(file)

def one(split, row):
    runs = []
    for episode in range(int(options["--episodes"])):
        done = row["sub_tasks"] if lads or episode % 4 == 0 else row["sub_tasks"][:1]
        completions = [{{"sub_task": name, "step": 9, "commanded": True}} for name in done]
        runs.append({{"episode": episode, "success": len(done) == len(row["sub_tasks"]), "completions": completions}})
    return {{"bundle_sha256": hashlib.sha256(open(options["--model"], "rb").read()).hexdigest(), "seed": int(options["--seed"]),
             "noise": options["--noise"], "episodes_per_instruction": int(options["--episodes"]), "splits": ["seen", "unseen"],
             "instructions": [{{"id": row["id"], "split": split, "runs": runs}}]}}

parts = [one(split, row) for split in ("seen", "unseen") for row in known[split] if options.get("--instruction") in (None, row["id"])]
with open(options["--json"], "w") as file:
    json.dump(shards.merge(parts, [part["instructions"][0]["id"] for part in parts]), file)
"""

TABLE = """
name = "tiny"
title = "Tiny"
measure = "n_rate"
data = "tiny.safetensors"
splits = ["seen", "unseen"]
headings = ["seen", "unseen"]
[evaluation]
episodes = 5
seed = 3
noise = "none"
[[track]]
name = "paper"
config = "base.toml"
note = "A note."
seeds = [0, 1]
[[system]]
id = "lads"
title = "LADS"
config = "lads.toml"
published = { seen = [2.25, 0.14] }
[[system]]
id = "lang_dt"
title = "Lang DT"
config = "lang_dt.toml"
published = {}
seeds = { paper = [4] }
"""


def write(folder):
    """Writes a table, its configurations, data and program."""
    beside = config.find("configs/tiny.toml").resolve().parent
    for name in ("tiny.environment.toml", "tiny.instructions.json"):
        shutil.copy(beside / name, folder)
    base = (beside / "tiny.toml").read_text()
    for name, steps in {"plans": 40, "low_level": 20, "high_level": 20}.items():
        shipped = config.read_toml("configs/tiny.toml")["training"][name]["steps"]
        base = base.replace(f"[training.{name}]\nsteps = {shipped}", f"[training.{name}]\nsteps = {steps}")
    (folder / "base.toml").write_text(base.replace("kmeans_step = 200", "kmeans_step = 15"))
    (folder / "lads.toml").write_text('[system]\nkind = "lads"\nregressed = false\n')
    (folder / "lang_dt.toml").write_text('[system]\nkind = "lang_dt"\n')
    (folder / "table.toml").write_text(TABLE)
    synthetic.write(folder / "tiny.safetensors", config.load(folder / "base.toml"), discarded='{"dl": 1}', attempts='{"dl": 4, "ld": 6}')
    executable(folder / "lads-run", PROGRAM.format(python=sys.executable, source=source(), instructions=folder / "tiny.instructions.json"))
    return folder


def executable(path, text):
    path.write_text(text)
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def source():
    return str(config.find("pyproject.toml").resolve().parent)


def python_path():
    """Returns the variable with which other processes find the exporter."""
    return source() + os.pathsep + os.environ.get("PYTHONPATH", "")


def play(folder, **changes):
    os.environ["PYTHONPATH"] = python_path()
    places = {"runs": folder / "runs", "lads_run": folder / "lads-run", "models": folder / "models"} | changes
    return run.run(folder / "table.toml", **places)
