"""Tests tables on real Ray clusters of this machine: a lost node changes no number, a node that lacks something is named, an interrupt keeps what is
done."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import tiny_table

# Before Ray is imported: no token in the user's home, no statistics to its makers.
os.environ |= {"RAY_AUTH_MODE": "disabled", "RAY_USAGE_STATS_ENABLED": "0", "PYTHONPATH": tiny_table.python_path()}
ray = pytest.importorskip("ray", reason="ray is not installed")

import yaml
from lads_exporter import __main__ as main
from lads_exporter import dataset
from lads_exporter.config import UserError
from lads_exporter.tables import jobs, node, on_ray
from lads_exporter.tables.commands import Command, Stopped
from ray.cluster_utils import Cluster

CODE = "the exporter's code"
NODE = {"num_cpus": 1, "object_store_memory": 80 << 20}


@pytest.fixture
def folder(tmp_path):
    return tiny_table.write(tmp_path)


@pytest.fixture
def cluster(monkeypatch):
    found = Cluster(initialize_head=True, head_node_args=NODE | {"include_dashboard": False})
    monkeypatch.setenv("RAY_ADDRESS", found.address)
    yield found
    ray.shutdown()
    found.shutdown()


def raylet(one):
    [process] = one.all_processes["raylet"]
    return process.process.pid


def trainings(name, value):
    """Lists the trainings that run with a value in their environment."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            if b"lads_exporter\0train" in (path / "cmdline").read_bytes() and f"{name}={value}".encode() in (path / "environ").read_bytes().split(b"\0"):
                found.append(path)
        except OSError:  # it has ended
            pass
    return found


def training_began(path):
    """Whether a training is past its start, in which nothing is loaded yet."""
    try:
        return "libtorch_cpu" in (path / "maps").read_text()
    except OSError:
        return False


def until(condition):
    while not condition():
        time.sleep(0.05)


def without_times(tables):
    """Reads a table without what differs from run to run."""
    [table] = json.loads(tables.read_text())["tables"].values()
    for row in [*table["jobs"], *table["tracks"][0]["rows"]]:
        row["training_s"] = 0
    return table


def test_a_lost_node_changes_no_number(folder, cluster, capsys):
    # What lies in its temporary folder when it is killed stays there.
    lost = cluster.add_node(**NODE, env_vars={"TMPDIR": str(folder)})
    pid, killed = raylet(lost), []

    def kill():
        until(lambda: any(training_began(path) for path in trainings("RAY_RAYLET_PID", pid)))
        cluster.remove_node(lost, allow_graceful=False)
        killed.append(lost)
        until(lambda: not trainings("RAY_RAYLET_PID", pid))

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    assert tiny_table.play(folder, engine="ray", runs=folder / "far", models=folder / "far/models")
    killer.join()
    assert killed and f"({lost.node_id[:8]}) is lost; what ran there begins anew" in capsys.readouterr().err

    assert tiny_table.play(folder, at_once=2)
    assert without_times(folder / "far/models/tables.json") == without_times(folder / "models/tables.json")
    names = lambda runs: sorted(str(path.relative_to(runs)) for path in runs.rglob("*") if path.is_file() and path.parent.name != "models")
    assert names(folder / "far") == names(folder / "runs")

    # What was run on the cluster is as good as what was run here.
    before = (folder / "far/models/tables.json").read_bytes()
    assert tiny_table.play(folder, runs=folder / "far", models=folder / "far/models")
    assert (folder / "far/models/tables.json").read_bytes() == before


def test_a_node_without_mujoco_is_named_and_the_others_go_on(folder, cluster):
    (folder / "table.toml").write_text(tiny_table.TABLE[: tiny_table.TABLE.rindex("[[system]]")])
    poor = cluster.add_node(**NODE, env_vars={"WITHOUT_MUJOCO": "1"})
    with pytest.raises(UserError, match=rf"1 of 2 jobs failed:\n  paper LADS seed \d: node .* \({poor.node_id[:8]}\): .*lads-run does not start \(1\): .*libmujoco\.so"):
        tiny_table.play(folder, engine="ray")
    [row] = json.loads((folder / "models/tables.json").read_text())["tables"]["tiny"]["jobs"]
    refused = [path for path in folder.glob("runs/tiny/paper/*") if f"seed{row['seed']}-" not in path.name]
    assert [[file.name for file in path.iterdir()] for path in refused] == [["log.txt"]]

    cluster.remove_node(poor)
    assert tiny_table.play(folder, engine="ray")
    assert [row["seed"] for row in json.loads((folder / "models/tables.json").read_text())["tables"]["tiny"]["jobs"]] == [0, 1]


def test_a_node_without_the_project_is_named_and_gets_nothing_else(folder, cluster, monkeypatch):
    other = folder / "other/lads_exporter"
    other.mkdir(parents=True)
    (other / "__init__.py").write_text("raise ImportError('of another time')\n")
    monkeypatch.chdir(folder)
    cluster.add_node(**NODE, env_vars={"PYTHONPATH": str(other.parent)})
    place = jobs.Place(folder / "runs", folder / "tiny.safetensors", "", folder / "lads-run")
    with on_ray.OnRay(place) as engine:
        engine.unfit[cluster.head_node.node_id] = "busy"
        command = Command(sys.executable, ["-c", "pass"], [], [], folder / "log.txt")
        with pytest.raises(UserError, match=r"node at [\d.]+: .*of another time; it needs the project"):
            engine.run(command)
        with pytest.raises(UserError, match="no node is left that can run it: .*of another time"):
            engine.run(command)


# Leaves a checkpoint when it is told to end, as a training does.
PATIENT = """
import signal, sys, time
def stop(*_):
    open(sys.argv[1], "w").write("half")
    sys.exit(130)
signal.signal(signal.SIGTERM, stop)
open({begun!r}, "w").close()
time.sleep(600)
"""


def test_the_dataset_comes_along_where_it_is_missing(folder, cluster):
    data, copier = folder / "tiny.safetensors", folder / "copier.py"
    place = jobs.Place(folder / "runs", data, dataset.sha256(data), folder / "lads-run")
    copier.write_text("import shutil, sys\nshutil.copy(sys.argv[1], sys.argv[2])\nprint(sys.argv[1])\n")
    with on_ray.OnRay(place) as engine:
        for copy in (folder / "one", folder / "two"):
            engine.run(Command(sys.executable, [copier, data, copy], [copier, data], [copy], folder / "log.txt"))
            assert dataset.sha256(copy) == place.data_sha256
            data.unlink(missing_ok=True)
    # The second one had it in its own folder, whose name is left out.
    assert [line for line in (folder / "log.txt").read_text().splitlines() if line.startswith("/")] == [str(data), "/tiny.safetensors"]


def test_an_interrupted_command_keeps_its_state_and_a_failed_one_its_output(folder, cluster):
    place = jobs.Place(folder / "runs", folder / "tiny.safetensors", dataset.sha256(folder / "tiny.safetensors"), folder / "lads-run")
    script, begun, log = folder / "patient.py", folder / "begun", folder / "log.txt"
    script.write_text(PATIENT.format(begun=str(begun)))
    with on_ray.OnRay(place) as engine:
        failing = Command(sys.executable, [folder / "none.py"], [], [], log)
        with pytest.raises(UserError, match=r"node .*: python\S* .*/none\.py ... failed \(2\): .*can't open file '.*none\.py'.*; all of it is in .*log\.txt"):
            engine.run(failing)

        command = Command(sys.executable, [script, folder / "checkpoint"], [script, place.data], [folder / "checkpoint"], log)
        threading.Thread(target=lambda: (until(begun.exists), engine.stop()), daemon=True).start()
        with pytest.raises(Stopped):
            engine.run(command)
    assert (folder / "checkpoint").read_text() == "half"


def test_an_interrupted_table_on_a_ray_of_its_own_goes_on(folder, monkeypatch):
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    command = [sys.executable, "-m", "lads_exporter", "table", folder / "table.toml", "--runs", folder / "runs", "--lads-run", folder / "lads-run", "--models", folder / "models", "--engine", "ray"]
    own = os.environ | {"OF_TEST": str(folder)}
    process = subprocess.Popen([str(part) for part in command], env=own, stderr=subprocess.PIPE, text=True)
    until(lambda: process.poll() is not None or any(training_began(path) for path in trainings("OF_TEST", folder)))
    assert process.poll() is None, process.stderr.read()
    process.send_signal(signal.SIGINT)
    _, said = process.communicate()
    assert process.returncode == 130 and "the same command goes on" in said
    assert not trainings("OF_TEST", folder) and not (folder / "models/tables.json").exists()
    assert tiny_table.play(folder)
    assert len(list(folder.glob("runs/tiny/paper/*"))) == 3


def test_what_a_node_lacks_or_has_otherwise_is_named(folder, monkeypatch):
    here = node.surroundings(folder / "lads-run")
    assert here[str(folder / "lads-run")] == dataset.sha256(folder / "lads-run")
    with pytest.raises(UserError, match="no program at .*none; build it there: make setup"):
        node.surroundings(folder / "none")
    with pytest.raises(UserError, match=r"lads-run does not start: .*Permission denied"):
        (folder / "lads-run").chmod(0o644)
        node.surroundings(folder / "lads-run")
    (folder / "lads-run").chmod(0o755)
    with pytest.raises(UserError, match="language.encoder = 'none': no folder"):
        node.surroundings(folder / "lads-run", "none")
    monkeypatch.setattr(node, "_code", lambda: "other")
    with pytest.raises(UserError, match=f"not what it is where the table runs: the exporter's code is other, not {here[CODE]}"):
        node.check(here, node.surroundings(folder / "lads-run"))


def test_a_file_that_came_damaged_is_refused(folder):
    outcome = node.Outcome("node a", "a", files={folder / "x": ("0" * 64, b"x")})
    with pytest.raises(UserError, match="node a: .*x came damaged; nothing was written"):
        on_ray.checked(folder / "x", outcome)
    with pytest.raises(UserError, match="node a: .*y was not written"):
        on_ray.checked(folder / "y", outcome)


def test_a_cluster_that_is_not_there_is_named(folder, monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:9")
    with pytest.raises(UserError, match="no Ray at RAY_ADDRESS=127.0.0.1:9: .*refused.*; start one with: ray start --head"):
        tiny_table.play(folder, engine="ray")


def test_what_ships_for_slurm_and_kubernetes_is_sound():
    """Tests the form of both, and that what they run is a command; which fields there are, only the operator knows."""
    beside = Path(__file__).parents[1]
    subprocess.run(["bash", "-n", beside / "cluster/slurm.sh"], check=True)
    manifest = yaml.safe_load((beside / "cluster/kuberay.yaml").read_text())
    entrypoint = manifest["spec"]["entrypoint"].split()
    assert entrypoint[1:3] == ["-m", "lads_exporter"] and main._parser().parse_args(entrypoint[3:]).engine == "ray"
    assert f"ray=={manifest['spec']['rayClusterSpec']['rayVersion']} " in (beside / "cluster.lock").read_text()
