"""Tests a table end to end on the tiny setting, what is refused, and the numbers."""

import dataclasses
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time

import pytest
import synthetic
import test_features
import test_frames
import tiny_table
from tiny_table import TABLE, play

from lads_exporter import __main__ as command, config, dataset, features
from lads_exporter.config import UserError
from lads_exporter.tables import definition, jobs, render
from lads_exporter.tables.commands import Command
from lads_exporter.tables.local import Local


@pytest.fixture
def folder(tmp_path):
    return tiny_table.write(tmp_path)


def goes_on_elsewhere(folder):
    """Checks that the numbers of finished jobs are taken from tables.json where no run is, and only those of the same inputs."""
    file, runs = folder / "models/tables.json", folder / "elsewhere"
    whole = file.read_text()
    assert play(folder, runs=runs)
    assert file.read_text() == whole and not runs.exists()

    # A job that is missing is run, alone: its results are those that were there, the time of training aside.
    found = json.loads(whole)
    gone = found["tables"]["tiny"]["jobs"].pop(1)
    file.write_text(json.dumps(found))
    assert play(folder, runs=runs)
    again = json.loads(file.read_text())["tables"]["tiny"]["jobs"][1]
    assert again | {"training_s": 0} == gone | {"training_s": 0}
    assert [path.name[: len("lads-seed1")] for path in runs.glob("tiny/paper/*")] == ["lads-seed1"]

    (folder / "other.toml").write_text(TABLE.replace("episodes = 5", "episodes = 6"))
    other = definition.load(folder / "other.toml")
    assert render.recorded(folder / "models", other, jobs.all_jobs(other, place_of(folder))) == ({}, None, 3)


def test_a_table_from_nothing_again_and_from_its_middle(folder, capsys):
    assert play(folder, at_once=2)
    found = json.loads((folder / "models/tables.json").read_text())["tables"]["tiny"]
    lads, lang_dt = found["tracks"][0]["rows"]
    assert found["environment"] == "tiny-bench"
    assert lads["seeds"] == [0, 1] and lang_dt["seeds"] == [4] and len(set(lads["bundle_sha256"])) == 2
    assert lads["splits"]["seen"]["n_rate"] == pytest.approx(5 / 3) and lads["splits"]["seen"]["n_rate_deviation"] == 0.0
    assert lads["splits"]["seen"]["episodes"] == 30 and lads["splits"]["seen"]["success_interval"][0] == pytest.approx(0.8865, abs=1e-3)
    assert found["uniform"]["seen"]["success"] == 0.6 and found["expert"]["attempts"] == 10 and found["expert"]["success"] == 0.9
    page = (folder / "models/TABLES.md").read_text()
    assert "| LADS | 0, 1 | 2.25 ± 0.14 | 1.67 ± 0.00 (1.49-1.84); all 100 % (89-100) | - |" in page
    assert "scripted expert" in page and "uniform random actions" in page and "`" + lads["bundle_sha256"][0][:12] + "`" in page
    assert "about" in capsys.readouterr().out

    # All is kept: nothing is trained or measured again.
    before = {path: path.stat().st_mtime_ns for path in folder.glob("runs/**/*") if path.is_file()}
    assert play(folder)
    assert before == {path: path.stat().st_mtime_ns for path in folder.glob("runs/**/*") if path.is_file()}

    goes_on_elsewhere(folder)

    # Without its results and bundle a job exports and measures again: the same bundle.
    trained = next(folder.glob("runs/tiny/paper/lads-seed0-*"))
    bundle = next(trained.glob("lads-*.onnx"))
    results = bundle.with_suffix(".results.json")
    for path in (bundle, results, folder / "models/tables.json"):
        path.unlink()
    assert play(folder)
    assert json.loads((folder / "models/tables.json").read_text())["tables"]["tiny"]["tracks"][0]["rows"][0]["bundle_sha256"] == lads["bundle_sha256"]

    # Results of another protocol and half a checkpoint are named and stay.
    other = json.loads(results.read_text()) | {"seed": 8}
    results.write_text(json.dumps(other))
    with pytest.raises(UserError, match=r"lads-\w+\.results\.json: of another protocol \(seed is 8, not 3\); it stays as it is"):
        play(folder)
    assert json.loads(results.read_text()) == other
    results.unlink()
    (trained / "summary.json").unlink()
    half = (trained / "checkpoint.pt").read_bytes()[:5000]
    (trained / "checkpoint.pt").write_bytes(half)
    (folder / "models/tables.json").unlink()
    with pytest.raises(UserError, match=r"1 of 3 jobs failed:\n  paper LADS seed 0: .*checkpoint\.pt: half written or damaged"):
        play(folder)
    assert (trained / "checkpoint.pt").read_bytes() == half
    (folder / "models/tables.json").write_text('{"mine": 1}')
    with pytest.raises(UserError, match="not this exporter's tables"):
        play(folder)


# The command with an interrupt that no blocked main thread sees: the system hands it to another thread, as it may.
ELSEWHERE = """
import signal, sys, threading, time
threading.Thread(target=time.sleep, args=(600,), daemon=True).start()
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
from lads_exporter.__main__ import main
sys.exit(main())
"""


@pytest.mark.parametrize("program", [("-m", "lads_exporter"), ("-c", ELSEWHERE)], ids=["main thread", "another thread"])
def test_an_interrupted_table_goes_on(folder, program):
    command = [sys.executable, *program, "table", folder / "table.toml", "--runs", folder / "runs", "--lads-run", folder / "lads-run", "--models", folder / "models"]
    process = subprocess.Popen([str(part) for part in command], env=os.environ | {"PYTHONPATH": tiny_table.python_path()}, stderr=subprocess.PIPE, text=True)
    while not list(folder.glob("runs/tiny/paper/lads-seed0-*/log.txt")):
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    assert process.wait() == 130 and "the same command goes on" in process.stderr.read()
    assert not (folder / "models/tables.json").exists()
    assert play(folder)
    assert len(list(folder.glob("runs/tiny/paper/*"))) == 3


def place_of(folder):
    data = folder / "tiny.safetensors"
    return jobs.Place(folder / "runs", data, dataset.sha256(data), folder / "lads-run")


def test_a_job_is_its_inputs(folder):
    place, table = place_of(folder), definition.load(folder / "table.toml")
    first = jobs.all_jobs(table, place)[0].folder
    assert jobs.all_jobs(definition.load(folder / "table.toml"), place)[0].folder == first
    (folder / "base.toml").write_text((folder / "base.toml").read_text().replace("clip = 1.0", "clip = 2.0"))
    assert jobs.all_jobs(definition.load(folder / "table.toml"), place)[0].folder != first


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('config = "lang_dt.toml"', 'config = "none.toml"'), r"system 'lang_dt' in track 'paper': no such file: .*none\.toml"),
        (("seeds = { paper = [4] }", "seeds = { fast = [4] }"), "system 'lang_dt': unknown track 'fast'; known: paper"),
        (("seeds = { paper = [4] }", 'weights = "dt"'), "system 'lang_dt': weights = 'dt': unknown system; known: lads, lang_dt"),
        (("published = {}", "published = { third = [1.0] }"), "the paper has no split 'third'"),
        (('id = "lang_dt"', 'id = "lads"'), "system 'lads' stands twice"),
        (('measure = "n_rate"', 'measure = "rate"'), "measure = 'rate': must be one of success, n_rate"),
        (('id = "lads"', 'id = "lads"\nsweep = { horizon = "5" }'), "system 'lads': sweep = .*: must be numbers by name"),
        (("seeds = [0, 1]", "seeds = [0, -1]"), "seeds of 'paper': must be lists of different whole numbers from 0 on"),
        (("seeds = [0, 1]", "seeds = [0, 0]"), "seeds of 'paper': must be lists of different whole numbers"),
        (('id = "lads"', 'id = "lads"\nsweep = { horizon = nan }'), "system 'lads': sweep = .*: must be numbers by name"),
        (("published = {}", 'published = { seen = ["a"] }'), r"system 'lang_dt': published = .*: must be \[mean, deviation\]"),
        (('name = "tiny"', 'name = "../tiny"'), "name = '../tiny': must be letters"),
        (('splits = ["seen", "unseen"]', 'splits = ["seen", "seen"]'), "split 'seen' stands twice"),
        (("episodes = 5", "episodes = true"), "episodes = True: must be at least 1"),
        (('noise = "none"', 'noise = "loud"'), "noise = 'loud': must be one of v0, v1, none"),
        (("[evaluation]", "[evaluations]"), r"\[evaluation\] is missing"),
        (("[[track]]", "[track]"), r"tracks are a list of tables, \[\[track\]\]"),
        (("episodes = 5", "episode = 5"), "unknown key 'episode'; key 'episodes' is missing"),
    ],
)
def test_a_bad_table_is_refused_before_anything_runs(folder, change, message):
    (folder / "table.toml").write_text(TABLE.replace(*change))
    with pytest.raises(UserError, match=message):
        play(folder)
    assert not (folder / "runs").exists()


def test_a_command_takes_one_thread_whatever_the_machine_has(tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    log = tmp_path / "log.txt"
    Local().run(Command(sys.executable, ["-c", "import os; print(os.environ['OMP_NUM_THREADS'])"], [], [], log))
    assert log.read_text() == "1\n"


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A table of one job, finished -> its folder."""
    folder = tiny_table.write(tmp_path_factory.mktemp("finished"))
    table = TABLE[: TABLE.rindex("[[system]]")].replace("seeds = [0, 1]", "seeds = [0]")
    (folder / "table.toml").write_text(table.replace('splits = ["seen", "unseen"]', 'splits = ["seen"]').replace('headings = ["seen", "unseen"]', 'headings = ["seen"]'))
    assert play(folder)
    return folder


@pytest.mark.parametrize("damage", [
    lambda file: file["tables"]["tiny"]["jobs"][0].update(identity=["a"]),
    lambda file: file["tables"]["tiny"]["jobs"][0].update(splits=None),
    lambda file: file["tables"]["tiny"]["jobs"][0]["splits"]["seen"].pop("n_rate"),
    lambda file: file["tables"]["tiny"]["jobs"][0]["splits"]["seen"].update(n_rate=float("nan")),
    lambda file: file["tables"]["tiny"]["jobs"][0]["splits"]["seen"].update(full_success_count=1 << 20),
    lambda file: file["tables"]["tiny"]["jobs"][0]["splits"]["seen"].update(k_rate=[1.0]),
    lambda file: file["tables"]["tiny"]["jobs"][0].update(bundle_sha256=None),
    lambda file: file["tables"]["tiny"].update(jobs=2 * file["tables"]["tiny"]["jobs"]),
    lambda file: file["tables"]["tiny"].update(jobs=["identity"]),
    lambda file: file["tables"]["tiny"].update(uniform_scores="none"),
    lambda file: file["tables"].update(other={"jobs": [], "uniform_scores": None}),
    lambda file: file.update(tables=[]),
    lambda file: file.update(format_version=2),
])  # fmt: skip
def test_damaged_tables_are_refused_and_stay(finished, tmp_path, damage):
    file = json.loads((finished / "models/tables.json").read_text())
    damage(file)
    (tmp_path / "tables.json").write_text(json.dumps(file))
    with pytest.raises(UserError, match="tables.json: not this exporter's tables .*; it stays as it is"):
        play(finished, runs=tmp_path / "runs", models=tmp_path)
    assert json.loads((tmp_path / "tables.json").read_text().replace("NaN", "0")) == json.loads(json.dumps(file).replace("NaN", "0"))
    assert not (tmp_path / "TABLES.md").exists() and not (tmp_path / "runs").exists()


def test_a_split_more_is_measured_where_it_is_missing(finished):
    """Tests that numbers without one of the table's splits are not taken for it."""
    table = definition.load(finished / "table.toml")
    known = render.recorded(finished / "models", table, jobs.all_jobs(table, place_of(finished)))
    assert len(known[0]) == 1 and known[1] and known[2] == 0
    more = (finished / "table.toml").read_text().replace('splits = ["seen"]', 'splits = ["seen", "unseen"]').replace('headings = ["seen"]', 'headings = ["seen", "unseen"]')
    (finished / "more.toml").write_text(more)
    table = definition.load(finished / "more.toml")
    assert render.recorded(finished / "models", table, jobs.all_jobs(table, place_of(finished))) == ({}, None, 0)


@pytest.mark.parametrize("change, message", [
    ({"data": "table.toml"}, r"table\.toml: no dataset of lads-collect"),
    ({"runs": "table.toml"}, r"--runs .*table\.toml: it is no folder"),
    ({"models": "table.toml"}, r"--models .*table\.toml: it is no folder"),
])  # fmt: skip
def test_paths_that_are_something_else_are_named_before_anything_runs(folder, change, message):
    with pytest.raises(UserError, match=message):
        play(folder, **{option: folder / name for option, name in change.items()})
    assert not (folder / "runs").exists()


def test_a_program_that_does_not_start_is_the_job_s_failure(folder):
    (folder / "no-program").write_text("text")
    with pytest.raises(UserError, match=r"3 of 3 jobs failed:\n  paper LADS seed 0: .*no-program: cannot be run \(Permission denied\)"):
        play(folder, lads_run=folder / "no-program")


def test_an_unknown_kind_of_system_is_named(folder):
    (folder / "lang_dt.toml").write_text('[system]\nkind = "dt"\n')
    with pytest.raises(UserError, match=r"system 'lang_dt' in track 'paper': .*kind = 'dt': unknown system; known: lads, vae, cluster, lang_dt, lisa"):
        play(folder)


def test_what_is_missing_is_named_with_its_remedy(folder):
    shutil.move(folder / "tiny.safetensors", folder / "elsewhere")
    with pytest.raises(UserError, match=r"no dataset at .*make collect ENV=tiny\); no program at .*cargo build --release -p lads-sim"):
        play(folder, lads_run=folder / "none")


def test_wilson_interval():
    """Tests against published values: 0 of 10, 5 of 10, 81 of 263 (Newcombe 1998, method 3)."""
    assert render.wilson(0, 10) == pytest.approx([0.0, 0.2775], abs=1e-4)
    assert render.wilson(5, 10) == pytest.approx([0.2366, 0.7634], abs=1e-4)
    assert render.wilson(81, 263) == pytest.approx([0.2553, 0.3662], abs=1e-4)


def test_the_tables_that_ship_are_sound():
    both, states = ["shipping", "paper"], {"lads", "lang_dt", "lisa", "vae", "cluster"}
    rows = {"kitchen": (both, states), "lorel": (both, states), "lorel-image": (["shipping"], states - {"cluster"}), "kitchen-image": (["shipping"], {"lads", "with_vae", "wo_cp", "wo_sr", "lang_dt", "lisa", "lisa_history", "vae"}), "kitchen-sizes": (["shipping"], {"base"})}
    for name, (tracks, systems) in rows.items():
        table = definition.load(f"tables/{name}.toml")
        assert [track.name for track in table.tracks] == tracks
        assert {row.id for row in table.systems} >= systems
        files = [path for track in table.tracks for row in table.rows(track) for path in table.configuration(track, row)]
        assert all(path.is_absolute() and ".." not in path.parts for path in files)


def change_base(folder, values, sections):
    """Gives keys of base.toml other values, and adds sections to it."""
    base = (folder / "base.toml").read_text()
    for key, new in values.items():
        base, count = re.subn(rf"^{key} = .*", f"{key} = {json.dumps(new)}", base, flags=re.MULTILINE)
        assert count == 1
    for name, rows in sections.items():
        base += f"\n[{name}]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in rows.items())
    (folder / "base.toml").write_text(base)


def test_systems_with_a_camera_share_the_encoder(folder):
    """Tests that one encoder of frames is trained for a table's systems, and that the frames are those of its dataset."""
    seen = {key: value for key, value in test_frames.SEEN.items() if key != "frames"}
    change_base(folder, {"observed": 0, "renoise": False, "schedule": "staged"}, {"images": seen, "images.frames": test_frames.APART})
    (folder / "table.toml").write_text('frames = "tiny.frames"' + TABLE.replace("seeds = [0, 1]", "seeds = [4]"))
    with pytest.raises(UserError, match=r"no frames at .*tiny\.frames; draw them first \(make frames DATA="):
        play(folder)
    data = synthetic.write(folder / "tiny.safetensors", config.load(folder / "base.toml"))
    test_frames.write_frames(folder / "tiny.frames", data, dataset_sha256="00")
    with pytest.raises(UserError, match="made of another dataset"):
        play(folder)
    test_frames.write_frames(folder / "tiny.frames", data)
    assert play(folder)
    stages = {path.parent.name[:4]: {row.split(",")[0] for row in path.read_text().splitlines()} for path in folder.glob("runs/tiny/paper/*/curves.csv")}
    assert stages == {"lads": {"stage", "frames", "plans", "low_level", "high_level"}, "lang": {"stage", "joint"}}
    assert len(list(folder.glob("runs/tiny/paper/encoder-seed4-*.pt"))) == 1
    found = json.loads((folder / "models/tables.json").read_text())["tables"]["tiny"]["jobs"]
    assert [row["summary"]["steps"]["frames"] for row in found] == [test_frames.APART["steps"]] * 2


def test_systems_with_a_frozen_encoder_learn_from_its_features(folder):
    """Tests that a table's features are those of its dataset, and that a job depends on how they were made."""
    change_base(folder, {"observed": test_features.JOINTS, "schedule": "staged"}, {"pretrained": test_features.SEEN, "history": test_features.HISTORY})
    base = (folder / "base.toml").read_text()
    longer = base.replace("[training.high_level]\nsteps = 20", "[training.high_level]\nsteps = 200")  # until its decisions are clear
    assert longer != base
    (folder / "base.toml").write_text(longer)
    lads = TABLE[: TABLE.index("[[system]]", TABLE.index("[[system]]") + 1)].replace("seeds = [0, 1]", "seeds = [4]")
    (folder / "table.toml").write_text('features = "tiny.features"' + lads)
    with pytest.raises(UserError, match=r"no features at .*tiny\.features; make them first \(python -m lads_exporter features\)"):
        play(folder)
    with pytest.raises(UserError, match=r"tiny has no systems that learn from frames; leave --frames out"):
        play(folder, frames=folder / "tiny.safetensors")

    drawer = tiny_table.executable(folder / "drawer", test_features.PROGRAM)
    features.make(config.load(folder / "base.toml"), folder / "tiny.safetensors", folder / "tiny.features", drawer, quiet=True)
    assert play(folder)
    (row,) = json.loads((folder / "models/tables.json").read_text())["tables"]["tiny"]["jobs"]
    assert row["seed"] == 4 and row["summary"]["device"] == "cpu" and set(row["summary"]["steps"]) == {"plans", "low_level", "high_level"}

    # Features of another encoder are of another job.
    (before,) = folder.glob("runs/tiny/paper/*")
    (folder / "tiny.features").unlink()
    base = (folder / "base.toml").read_text()
    (folder / "base.toml").write_text(base.replace(f'"{test_features.SEEN["encoder"]}"', '"random-5"').replace(f"features = {test_features.F}", f"features = {test_features.F // 4 * 5}"))
    with pytest.raises(UserError, match="no features"):
        play(folder)
    features.make(config.load(folder / "base.toml"), folder / "tiny.safetensors", folder / "tiny.features", drawer, quiet=True)
    assert play(folder) and len(list(folder.glob("runs/tiny/paper/*"))) == 2 and before.exists()

    (folder / "table.toml").write_text('frames = "tiny.frames"\nfeatures = "tiny.features"' + lads)
    with pytest.raises(UserError, match="frames and features exclude each other"):
        play(folder)


def test_a_table_says_on_what_its_systems_were_trained(folder, monkeypatch, capsys):
    """Tests the device: what is refused, what a job's training is told, and what the page says."""
    monkeypatch.setattr(command.sys, "argv", ["lads_exporter", "table", str(folder / "table.toml"), "--device", "cuda"])
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert command.main() == 2 and "--device cuda: this machine has no usable CUDA GPU; use --device cpu" in capsys.readouterr().err
    with pytest.raises(UserError, match=r"--device cuda: the engine ray gives its tasks a CPU each; leave --device out, or use --engine local"):
        play(folder, engine="ray", device="cuda")

    table = definition.load(folder / "table.toml")
    told = {device: jobs.all_jobs(table, dataclasses.replace(place_of(folder), device=device))[0] for device in ("cpu", "cuda")}
    assert "--device" not in told["cpu"]._training().line() and " --device cuda" in " ".join(told["cuda"]._training().line())
    assert told["cpu"].identity == told["cuda"].identity

    assert play(folder)
    found = render.read(folder / "models/tables.json")
    summaries = [summary for row in found["tables"]["tiny"]["tracks"][0]["rows"] for summary in row["summary"]]
    assert [summary["device"] for summary in summaries] == ["cpu"] * 3
    assert " min on " not in render.markdown(found)
    summaries[0]["device"] = "GPU of a maker"
    del summaries[1]["device"]  # of a file that was written before devices were
    assert "| 0 min on GPU of a maker |" in render.markdown(found)
