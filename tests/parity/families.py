"""Makes a small random policy of every family, and an episode of each by the exporter's twin of the schedule, for the tests of `lads-tests`
that the variable LADS_FAMILIES gives them to: `python tests/parity/families.py FOLDER`.

A folder is made as a whole or not at all. What can fail: FOLDER cannot be written.
"""

import shutil
import sys
import tempfile
from pathlib import Path

from lads_exporter import bundle, episode, kinds

STEPS = 200


def fill(folder: Path) -> None:
    """Writes a bundle and an episode of each kind into a folder."""
    for kind in kinds.KINDS:
        _, model = kinds.export(kind, seed=0)
        bundle.save(model, folder / f"{kind}.onnx")
        episode.write(folder / f"{kind}.onnx", folder / f"{kind}.safetensors", STEPS, seed=0)


def make(folder: Path) -> None:
    """Makes the folder anew; an older one stays until the new one is whole."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as draft:
        fill(Path(draft))
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(draft, folder)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("families.py FOLDER: name the folder to make")
    make(Path(sys.argv[1]))
