"""Every snippet of Python in the documents runs as it is typed."""

import os
import re

import pytest

from conftest import PROJECT

DOCUMENTS = ("README.md", "docs/python.md", "runtime/python/README.md")
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with the project's models and sources in which snippets may write."""
    for name in ("models", "runtime"):
        os.symlink(PROJECT / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", DOCUMENTS)
def test_snippets_run_as_typed(name, folder, language_cache, monkeypatch, capsys):
    monkeypatch.setenv("LADS_CACHE", str(language_cache))
    # FrankaKitchen-v1 asserts on the MuJoCo of the tests; the exporter has what it lacks.
    from gymnasium_robotics.utils import mujoco_utils
    from lads_exporter import official

    monkeypatch.setattr(mujoco_utils, "get_joint_qpos", official.joint_qpos)
    monkeypatch.setattr(mujoco_utils, "get_joint_qvel", official.joint_qvel)
    text = (PROJECT / name).read_text()
    blocks = list(BLOCK.finditer(text))
    assert blocks and len(blocks) == text.count("```python")
    space = {"__name__": "document"}
    for block in blocks:
        line = text[: block.start()].count("\n") + 1
        # Errors name the document's own lines.
        exec(compile("\n" * line + block.group(1), str(PROJECT / name), "exec"), space)
    if name == "docs/python.md":
        said = capsys.readouterr().out
        assert "its dtype is float64" in said and "INCONCLUSIVE" in said and "success 1.000" in said, said
        assert "drawer" in said, said
        assert "double-precision evaluation" in said and "\njoints" in said, said
        assert (folder / "certificate.html").exists() and (folder / "certificate.json").exists()
