"""Writes the files of the exporter's commands: whole or not at all, and never over what is read.

A symbolic link is followed, so that what it leads to is replaced in its own folder; a device or a FIFO is written into.
"""

import os
import stat
import tempfile
from pathlib import Path

from .config import UserError


def check_apart(inputs, outputs):
    """Refuses an output that is an input or another output; devices may be named more than once."""
    taken = [(path, "is read") for path in inputs if path]
    for path in outputs:
        for other, what in taken:
            if _same(path, other):
                raise UserError(f"{path}: the same file {what}; name another output")
        taken.append((path, "is written too"))


def _same(a, b):
    try:
        a_is, b_is = os.stat(a), os.stat(b)
    except FileNotFoundError:
        return os.path.realpath(a) == os.path.realpath(b)
    return os.path.samestat(a_is, b_is) and (stat.S_ISREG(a_is.st_mode) or stat.S_ISDIR(a_is.st_mode))


def write_atomically(path, data):
    """Writes beside the target and renames: a reader sees the old file or the new one, never a part."""
    path = Path(path)
    if path.exists() and not path.is_file():
        if path.is_dir():
            raise UserError(f"{path}: it is a folder; name a file")
        with open(path, "ab", buffering=0) as stream:
            rest = memoryview(data)
            while rest:
                rest = rest[stream.write(rest) :]
        return
    path = Path(os.path.realpath(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    mode = stat.S_IMODE(path.stat().st_mode) if path.exists() else 0o644
    if path.exists() and not os.access(path, os.W_OK):
        raise UserError(f"{path}: it is read-only; name another file")
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.name, suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, mode)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise
