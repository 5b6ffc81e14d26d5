"""Estimates a control step on boards that are not at hand: instructions by QEMU, cycles of the inner loops by llvm-mca.

    lads compile models/kitchen.onnx --weights f32 --emit-c f32.c
    python3 benches/boards/measure.py steps f32=f32.c int8=int8.c    instructions of a step, per target and kernel
    python3 benches/boards/measure.py loops                          cycles per 64 weights, per core and loop
    python3 benches/boards/measure.py table                          the tables of both, from results.json

`steps` builds the static library for x86-64, aarch64 and armv7 (`runtime/ffi/archive.sh`; `RUSTC`, `CARGO` and `CARGO_FLAGS` reach it),
links `steps.c` and an image, and counts with `count.c`, a plugin of qemu-user, whole runs of 50 and of 150 steps: their difference is two
contexts of 50 steps. `loops` compiles lads-kernels for aarch64 to assembly, takes the loops that have no other loop inside, and gives them
to `llvm-mca` (`LLVM_MCA`; 19 or later knows the cores). Both write `results.json` beside this file. What is missing is named.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
RESULTS = HERE / "results.json"

# Target: the prefix of its GCC and binutils, and per kernel QEMU with the CPU that chooses it.
TARGETS = {
    "x86_64-unknown-linux-gnu": ("", {"avx2": ["qemu-x86_64", "-cpu", "max"], "portable": ["qemu-x86_64", "-cpu", "max"]}),
    "aarch64-unknown-linux-gnu": (
        "aarch64-linux-gnu-",
        {
            "dotprod": ["qemu-aarch64", "-cpu", "max"],
            "neon": ["qemu-aarch64", "-cpu", "cortex-a53"],
            "portable": ["qemu-aarch64", "-cpu", "max"],
        },
    ),
    "armv7-unknown-linux-gnueabihf": ("arm-linux-gnueabihf-", {"portable": ["qemu-arm", "-cpu", "max"]}),
}

# Core: the name of the model in LLVM, and whether it is the core's own.
CORES = {
    "Cortex-A53": ("cortex-a53", "its own"),
    "Cortex-A72": ("cortex-a72", "Cortex-A57's"),
    "Cortex-A76": ("neoverse-n1", "Neoverse N1's, the same design"),
    "Cortex-A78": ("neoverse-n2", "Neoverse N2's, the design after it: nearest"),
}
DOT = {"Cortex-A76", "Cortex-A78"}

# Where such a core is found, and its clock [GHz].
BOARDS = {
    "Cortex-A53": ("Raspberry Pi 3", 1.2),
    "Cortex-A72": ("Raspberry Pi 4", 1.8),
    "Cortex-A76": ("Raspberry Pi 5", 2.4),
    "Cortex-A78": ("Jetson Orin Nano", 1.5),
}

STEPS = [50, 150]


def run(*command: str | Path, **options) -> str:
    """Returns the output of a command; if it fails, ends this program with what the command wrote."""
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, **options)
    if done.returncode:
        sys.exit(f"measure.py: {' '.join(map(str, command))}\n{done.stdout}{done.stderr}")
    return done.stdout + done.stderr


def missing(*tools: str) -> bool:
    lacking = [tool for tool in tools if not shutil.which(tool)]
    for tool in lacking:
        print(f"skipped: {tool} is not installed")
    return bool(lacking)


def save(key: str, value: dict) -> None:
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    results[key] = value
    RESULTS.write_text(json.dumps(results, indent=1, sort_keys=True) + "\n")


def steps(images: dict[str, Path]) -> None:
    """Counts the instructions of a control step, by target, kernel and image."""
    found: dict[str, dict] = {}
    skipped = []
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        run("cc", "-O2", "-shared", "-fPIC", HERE / "count.c", "-o", work / "count.so")
        for target, (prefix, kernels) in TARGETS.items():
            if missing(f"{prefix}gcc", *{command[0] for command in kernels.values()}):
                skipped.append(target)
                continue
            tools = {"LD": "ld", "OBJCOPY": "objcopy", "AR": "ar", "NM": "nm"}
            env = os.environ | {name: prefix + tool for name, tool in tools.items()}
            archive = work / f"{target}.a"
            own = [] if target.startswith(os.uname().machine) else [target]
            run("sh", ROOT / "runtime/ffi/archive.sh", archive, *own, env=env)
            for name, image in images.items():
                program = work / f"{target}-{name}"
                symbol, size = image_of(image)
                run(
                    f"{prefix}gcc", "-static", "-O2", "-ffp-contract=off", f"-DIMAGE={symbol}", f"-DIMAGE_BYTES={size}",
                    "-I", ROOT / "runtime/ffi/include", HERE / "steps.c", image, archive, "-lm", "-o", program,
                )  # fmt: skip
                for kernel, qemu in kernels.items():
                    result = count(qemu, work / "count.so", program, kernel)
                    found.setdefault(target, {}).setdefault(kernel, {})[name] = result
                    print(target, kernel, name, result)
    actions = {name: {kernel[name]["actions"] for target in found.values() for kernel in target.values()} for name in images}
    for name, bits in actions.items():
        if len(bits) > 1:
            sys.exit(f"measure.py: {name}: the bits of the actions differ: {found}")
    for target, kernels in found.items():
        for kernel in set(kernels) - {"portable"}:
            same = [name for name in images if kernels[kernel][name]["instructions"] == kernels["portable"][name]["instructions"]]
            if same and "portable" in kernels:
                sys.exit(f"measure.py: {target}: {kernel} takes as many instructions as portable with {', '.join(same)}: it did not run")
    known = json.loads(RESULTS.read_text()).get("steps", {}) if RESULTS.is_file() else {}
    save("steps", known | found)
    if skipped:
        sys.exit(f"measure.py: kept what was known of {', '.join(skipped)}")


def image_of(source: Path) -> tuple[str, int]:
    """Returns the symbol and the bytes of the image in a source of `lads compile --emit-c`."""
    with source.open() as lines:
        for line in lines:
            if declared := re.match(r"extern const unsigned char (\w+)\[(\d+)\];", line):
                return declared[1], int(declared[2])
    sys.exit(f"measure.py: {source}: not a source of lads compile --emit-c")


def count(qemu: list[str], plugin: Path, program: Path, kernel: str) -> dict:
    """Counts the instructions of a mean step, and returns the bits of the actions of all steps."""
    portable = ["portable"] if kernel == "portable" else []
    outputs = [run(*qemu, "-plugin", plugin, "-d", "plugin", program, str(n), *portable) for n in STEPS]
    totals = [int(re.search(r"instructions (\d+)", output)[1]) for output in outputs]
    actions = re.search(r"actions (\w+)", outputs[1])[1]
    return {"instructions": (totals[1] - totals[0]) // (STEPS[1] - STEPS[0]), "actions": actions}


def loops() -> None:
    """Estimates the cycles per 64 weights of the inner loops, by core, kernel and rows."""
    mca = os.environ.get("LLVM_MCA", "llvm-mca")
    if missing(mca):
        return
    found: dict[str, dict] = {core: {} for core in CORES}
    for (kernel, rows), (weights, body) in sorted(innermost(assembly()).items()):
        for core, (model, _) in CORES.items():
            if kernel == "int8 dotprod" and core not in DOT:
                continue
            arithmetic = [line for line in body if VECTORS.match(line)]
            loads = [line for line in body if LOADS.match(line)]
            result = {
                "cycles": per_64(cycles(mca, model, body), weights),
                "arithmetic": per_64(bound(mca, model, arithmetic), weights),
                "loads": per_64(bound(mca, model, loads), weights),
                "instructions": per_64(len(body), weights),
            }
            found[core][f"{kernel}, {rows} row{'s' * (rows > 1)}"] = result
            print(core, kernel, rows, result)
    save("loops", found)


def per_64(value: float, weights: int) -> float:
    return round(value * 64 / weights, 2)


def assembly() -> str:
    """Compiles lads-kernels for aarch64 to assembly, as in an optimised build."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "kernels.s"
        cargo = os.environ.get("CARGO", "cargo")
        run(
            cargo, "rustc", "--locked", "-p", "lads-kernels", "--profile", "archive", "--target", "aarch64-unknown-linux-gnu",
            "--config", 'profile.archive.lto="off"', *os.environ.get("CARGO_FLAGS", "").split(),
            "--", "--emit", f"asm={output}", "-C", "debuginfo=0", *os.environ.get("RUSTC_FLAGS", "").split(),
            cwd=ROOT,
        )  # fmt: skip
        return output.read_text()


LOADS = re.compile(r"(ldr|ldp|ldur|ld1r|ld1|prfm)\b")
VECTORS = re.compile(r"\w+\s.*\bv\d+\.\d+[bhsd]|dup\b|mov\tv")
BRANCH = re.compile(r"(?:b\.\w+|cbn?z\s+\w+,|tbn?z\s+\w+,\s*#\d+,)\s+(\.L\w+)$")


def innermost(text: str) -> dict[tuple[str, int], tuple[int, list[str]]]:
    """Finds the loops of one block over panels: kernel and rows, and the weights that a round reads."""
    best: dict[tuple[str, int], tuple[int, list[str]]] = {}
    function, label, body = "", "", []
    for line in text.splitlines():
        if named := re.match(r"([\w.$]+):", line):
            if named[1].startswith(".L"):
                label, body = named[1], []
            else:
                function = named[1]
            continue
        line = line.strip()
        if not line or line.startswith((".", "/", "#")):
            continue
        body.append(line)
        branch = BRANCH.match(line)
        if branch and branch[1] == label and ("linear" in function or "aarch643dot" in function):
            kind = classify(body[:-1])
            if kind and kind[1] > best.get(kind[0], (0, []))[0]:
                best[kind[0]] = (kind[1], body[:-1])
    return best


def classify(body: list[str]) -> tuple[tuple[str, int], int] | None:
    """Returns kernel and rows of a loop over a panel, and its weights; None for other loops."""
    # LLVM writes some of them with the vectors' shape behind the name, GNU behind the registers.
    names = Counter(line.split()[0].split(".")[0] for line in body)
    names["ext"] = sum(names[name] for name in ("sshll", "sshll2", "sxtl", "sxtl2"))
    if names["prfm"] == 0:
        return None
    if zips := names["zip1"] + names["zip2"]:
        # A register of sixteen weights is multiplied twice for each row.
        return (("int8 dotprod", names["sdot"] // (2 * zips)), 16 * zips) if names["sdot"] else None
    registers = sum(line.count("q") for line in body if re.match(r"ld[rpu]+\b", line) and "sp" not in line)
    products = names["smlal"] + names["smlal2"]
    if products:
        kernel, each = ("int8", 16) if names["ext"] else ("int16", 8)
        return ((kernel, 4 * products // (each * registers)), each * registers) if registers else None
    if names["fmul"] and names["fmul"] == names["fadd"] and not names["fcvtl"] and not names["shll"] and not names["ushll"]:
        rows = names["fmul"] // registers if registers else 0
        return (("f32", rows), 4 * registers) if rows * registers == names["fmul"] else None
    return None


def simulated(mca: str, model: str, body: list[str], rounds: int) -> str:
    return run(mca, "-mtriple=aarch64", f"-mcpu={model}", f"-iterations={rounds}", "-instruction-info=0", input="\n".join(body) + "\n")


def cycles(mca: str, model: str, body: list[str]) -> float:
    """Returns the cycles of a round, without the first and the last rounds."""
    total = [int(re.search(r"Total Cycles:\s+(\d+)", simulated(mca, model, body, n))[1]) for n in (100, 300)]
    return (total[1] - total[0]) / 200


def bound(mca: str, model: str, body: list[str]) -> float:
    """Returns the cycles for which the busiest unit of the core is taken by these instructions."""
    return float(re.search(r"Block RThroughput:\s+([\d.]+)", simulated(mca, model, body, 100))[1])


def table() -> None:
    results = json.loads(RESULTS.read_text())
    counted = results["steps"]
    names = sorted({name for target in counted.values() for kernel in target.values() for name in kernel})
    print("| target | kernels |" + "".join(f" {name} |" for name in names) + "\n|---|---|" + "---|" * len(names))
    for target, kernels in counted.items():
        for kernel, images in kernels.items():
            numbers = "".join(f" {images[name]['instructions'] / 1e6:.3f} |" for name in names)
            print(f"| {target.split('-')[0]} | {kernel} |{numbers}")
    timed = results["loops"]
    print("\n| loop |" + "".join(f" {core} |" for core in timed) + "\n|---|" + "---|" * len(timed))
    for loop in sorted({loop for core in timed.values() for loop in core}):
        row = ""
        for core in timed.values():
            one = core.get(loop)
            row += f" {one['cycles']:.1f} / {max(one['loads'], one['arithmetic']):.1f} |" if one else " |"
        print(f"| {loop} |{row}")
    estimates(results, names)


def estimates(results: dict, names: list[str]) -> None:
    """Estimates the time of a step with everything in the caches: its instructions, at the rate of the inner loop over two rows."""
    print("\n| core | board | clock [GHz] |" + "".join(f" {name} [us] |" for name in names) + "\n|---|---|---|" + "---|" * len(names))
    for core, (board, clock) in BOARDS.items():
        counted = results["steps"]["aarch64-unknown-linux-gnu"]["dotprod" if core in DOT else "neon"]
        row = ""
        for name in names:
            kernel = "f32" if not name.startswith("int8") else "int8 dotprod" if core in DOT else "int8"
            loop = results["loops"][core][f"{kernel}, 2 rows"]
            cycles_each = loop["cycles"] / loop["instructions"]
            row += f" {counted[name]['instructions'] * cycles_each / clock / 1e3:.0f} |"
        print(f"| {core} | {board} | {clock} |{row}")


def main() -> None:
    arguments = sys.argv[1:]
    if arguments[:1] == ["steps"] and len(arguments) > 1 and all("=" in pair for pair in arguments[1:]):
        steps({name: Path(path) for name, path in (pair.split("=", 1) for pair in arguments[1:])})
    elif arguments == ["loops"]:
        loops()
    elif arguments == ["table"]:
        table()
    else:
        print(__doc__, file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
