"""Formats of numbers at export: where the reference beside a bundle is of that bundle, `lads-run tune` chooses them.

Nothing here fails an export: with a damaged reference, or a program that does not run or refuses, the bundle stays at 32 bits, and the sentence
says why.
"""

import json
import subprocess
from pathlib import Path


def beside(bundle, sha256, program):
    """Tunes a bundle that was just exported if its reference lies beside it. Returns a sentence on what came of it."""
    path = Path(bundle).with_suffix(".reference.json")
    wide = f"{bundle}: numbers of 32 bits"
    if not path.is_file():
        return f"{wide}; smaller ones need a reference: python -m lads_exporter reference, then lads-run tune --model {bundle}"
    try:
        of = json.loads(path.read_bytes())["bundle_sha256"]
    except (ValueError, KeyError, TypeError) as error:
        return f"{wide}; {path} is not a reference ({error!r}): make it anew, then lads-run tune --model {bundle}"
    if of != sha256:
        return f"{wide}; {path} is of another bundle: make it anew, then lads-run tune --model {bundle}"
    try:
        done = subprocess.run([str(program), "tune", "--model", str(bundle), "--reference", str(path)], capture_output=True, text=True)
    except OSError as error:
        return f"{wide}; {program} cannot be run ({error.strerror}): build it, then lads-run tune --model {bundle}"
    if done.returncode:
        return f"{wide}; {program} tune: {(done.stderr.strip() or 'it says nothing').splitlines()[-1]}"
    return done.stdout.strip()
