#!/usr/bin/env python3
"""Fetches ONNX Runtime's shared library, the main peer of the benchmarks, into vendor/onnxruntime/.

It comes from the pinned and checksummed PyPI wheel, which is unpacked, never installed. A second run does nothing. The folder is
put in place in one rename. Any failure ends with one line on stderr and exit status 2.
"""

import importlib.util
import pathlib
import platform
import sys
import tempfile
import zipfile

ROOT = pathlib.Path(__file__).resolve().parent.parent
VERSION = "1.31.1"  # its API level is the one that the crate `ort` is built for, see Cargo.toml
LIBRARY = f"libonnxruntime.so.{VERSION}"
MAPPING = [(f"onnxruntime/capi/{LIBRARY}", "libonnxruntime.so"), ("onnxruntime/LICENSE", "LICENSE")]
SHA256 = {
    ("onnxruntime", "x86_64"): "5752bd508126ae7c49894d3b9d2e83f0c3d487319246d04c444b393308d7ad7f",
    ("onnxruntime", "aarch64"): "da05378364c44d4407e463982d2bf8d5e4cfea873283757e48beeb41df97b7f3",
}


def harness():
    """Loads the simulator's setup script, whose downloads and checks are the same."""
    spec = importlib.util.spec_from_file_location("harness_setup", ROOT / "sim-harness" / "setup.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.SHA256.update(SHA256)
    return module


def fill(setup, folder, stamp, arch):
    folder.parent.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".vendor-", dir=ROOT) as temporary:
        temporary = pathlib.Path(temporary)
        print(f"fetching onnxruntime {VERSION}", flush=True)
        new = temporary / "new"
        setup.unpack(setup.download("onnxruntime", VERSION, arch, temporary), MAPPING, new)
        (new / "STAMP").write_text(stamp)
        if folder.exists():
            folder.rename(temporary / "old")
        new.rename(folder)


def main():
    setup, arch = harness(), platform.machine()
    folder = ROOT / "vendor" / "onnxruntime"
    try:
        if sys.platform != "linux" or ("onnxruntime", arch) not in SHA256:
            raise setup.SetupError(f"no pinned ONNX Runtime for {sys.platform} {arch}; supported: Linux on x86_64 or aarch64")
        stamp = f"{VERSION} {SHA256['onnxruntime', arch]}\n"
        if (folder / "STAMP").is_file() and (folder / "STAMP").read_text() == stamp:
            print("vendor/onnxruntime/ is up to date")
            return 0
        fill(setup, folder, stamp, arch)
        print(f"vendor/onnxruntime/ is ready: ONNX Runtime {VERSION} ({arch})")
        return 0
    except (setup.SetupError, OSError, zipfile.BadZipFile) as error:
        print(f"setup: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
