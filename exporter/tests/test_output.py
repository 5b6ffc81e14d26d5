"""Tests where the exporter's commands write: files whole, links followed, devices left what they are, nothing over what is read."""

import os
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from lads_exporter import __main__ as command
from lads_exporter import output
from lads_exporter.config import UserError


def test_a_file_is_replaced_as_a_whole(tmp_path):
    target = tmp_path / "a"
    target.write_bytes(b"old and longer")
    target.chmod(0o640)
    output.write_atomically(target, b"new")
    assert target.read_bytes() == b"new" and stat.S_IMODE(target.stat().st_mode) == 0o640
    assert list(tmp_path.iterdir()) == [target]


def test_links_are_followed(tmp_path):
    (tmp_path / "there").mkdir()
    link = tmp_path / "link"
    link.symlink_to("there/a")
    output.write_atomically(link, b"new")
    assert link.is_symlink() and (tmp_path / "there" / "a").read_bytes() == b"new"


def test_devices_and_fifos_are_written_into(tmp_path):
    output.write_atomically("/dev/null", b"gone")
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)
    fifo, got = tmp_path / "fifo", []
    os.mkfifo(fifo)
    reader = threading.Thread(target=lambda: got.append(fifo.read_bytes()))
    reader.start()
    output.write_atomically(fifo, b"x" * 200_000)
    reader.join()
    assert got == [b"x" * 200_000] and stat.S_ISFIFO(fifo.stat().st_mode)


def test_an_output_is_no_input(tmp_path):
    model = tmp_path / "m.onnx"
    model.write_bytes(b"model")
    link = tmp_path / "link"
    link.symlink_to(model)
    for other in (model, link, tmp_path / "x" / ".." / "m.onnx"):
        with pytest.raises(UserError, match="is read"):
            output.check_apart([model], [other])
    with pytest.raises(UserError, match="written too"):
        output.check_apart([], [tmp_path / "new", tmp_path / "." / "new"])
    output.check_apart([model, None], [tmp_path / "new"])
    output.check_apart(["/dev/null"], ["/dev/null", "/dev/null"])


def test_commands_refuse_to_write_over_what_they_read(tmp_path, monkeypatch, capsys):
    files = {name: tmp_path / name for name in ("a.toml", "m.onnx", "r.json", "m.md")}
    for path in files.values():
        path.write_bytes(b"mine")
    config, model, results, _ = map(str, files.values())
    for line in (
        ["random", "--config", config, "-o", config],
        ["reference", "--model", model, "-o", model],
        ["export", "--run", str(tmp_path), "-o", results, "--results", results],
        ["card", "--run", str(tmp_path), "-o", model, "--results", str(files["m.md"])],
    ):
        monkeypatch.setattr("sys.argv", ["lads_exporter", *line])
        assert command.main() == 2, line
        assert "is read" in capsys.readouterr().err
    assert all(path.read_bytes() == b"mine" for path in files.values())


def test_setup_replaces_no_folder_of_somebody_else(tmp_path):
    (tmp_path / "mine").write_text("work of years")
    setup = Path(__file__).parents[2] / "sim-harness" / "setup.py"
    done = subprocess.run([sys.executable, setup, "--vendor", tmp_path], capture_output=True, text=True)
    assert done.returncode == 2 and "something else" in done.stderr and len(done.stderr.splitlines()) == 1
    assert (tmp_path / "mine").read_text() == "work of years"


def test_commands_do_not_write_over_what_they_read(tmp_path):
    model, sentences = tmp_path / "policy.onnx", tmp_path / "sentences.json"
    for command, read in (
        (["episode", model], model),
        (["calibrate", "--config", "configs/kitchen-small.toml", "--sentences", sentences], sentences),
    ):
        read.write_bytes(b"kept")
        done = subprocess.run([sys.executable, "-m", "lads_exporter", *map(str, command), "-o", str(read)], capture_output=True, text=True)
        assert done.returncode == 2 and str(read) in done.stderr, done.stderr
        assert read.read_bytes() == b"kept"
