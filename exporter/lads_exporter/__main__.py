"""Command line: demonstrations to a policy to one ONNX file."""

import argparse
import dataclasses
import hashlib
import json
import sys
from pathlib import Path

from . import output
from .config import UserError


def _encode(setting):
    from . import language

    return language.encode(setting.config.language, [row["text"] for row in setting.instructions])


def _seed(text):
    """Reads a seed: what numpy, PyTorch and the runtime all take."""
    if not (text.isascii() and text.isdigit() and int(text) < 1 << 63):
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number from 0 to {(1 << 63) - 1}")
    return int(text)


def _random(arguments):
    from . import bundle, config, kinds, random_policy

    read = [path for path in (arguments.config, arguments.rendering) if path]
    output.check_apart(read, [arguments.output])
    if arguments.kind is not None:
        if arguments.rendering:
            raise UserError("--rendering: it is of a configuration's policy; give --config, or leave it out")
        _, model = kinds.export(arguments.kind, arguments.seed)
    else:
        rendering = json.loads(Path(arguments.rendering).read_text()) if arguments.rendering else None
        setting = dataclasses.replace(config.load(arguments.config), rendering=rendering)
        _, model = random_policy.export(setting, _encode(setting), arguments.seed)
    print(f"{arguments.output}: random weights, sha256 {bundle.save(model, arguments.output)}")


def _episode(arguments):
    from . import episode

    output.check_apart([arguments.model], [arguments.output])
    margin = episode.write(arguments.model, arguments.output, arguments.steps, arguments.seed)
    print(f"{arguments.output}: {arguments.steps} steps, selections with a margin of {margin:.4g}")


def _growth(arguments):
    from . import config, growth

    for name in growth.export(config.load(arguments.config), Path(arguments.output), arguments.seed):
        print(f"{arguments.output}/{name}", flush=True)


def _device(name):
    import torch

    if name == "cuda" and not torch.cuda.is_available():
        raise UserError("--device cuda: this machine has no usable CUDA GPU; use --device cpu")
    return torch.device(name)


def _train(arguments):
    import torch

    from . import config, dataset, features, training

    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    setting = config.load(arguments.config, *arguments.system)
    data = features.attach(dataset.load(arguments.data, setting, arguments.frames), setting, arguments.features)
    setting = dataclasses.replace(setting, rendering=data.rendering)
    device = _device(arguments.device)
    trainer = training.Trainer(setting, data, _encode(setting), arguments.out, device, arguments.seed)
    if not trainer.run(resume=arguments.resume, encoder=arguments.encoder):
        print(f"stopped; continue with --resume ({arguments.out})", file=sys.stderr)
        return 130
    print(f"{arguments.out}: trained; next: python -m lads_exporter export --run {arguments.out} -o models/{setting.config.name}.onnx")
    return 0


def _features(arguments):
    from . import config, features

    output.check_apart([arguments.data], [arguments.output])
    setting = config.load(arguments.config, *arguments.system)
    if not setting.config.pretrained.encoder:
        raise UserError(f"{setting.config.name} has no frozen encoder: no [pretrained] in {arguments.config}")
    features.make(setting, arguments.data, arguments.output, arguments.lads_run, arguments.threads)
    print(f"{arguments.output}: whole; next: python -m lads_exporter train --config {arguments.config} --data {arguments.data} --features {arguments.output}")


def _check_card(arguments, more):
    """Refuses a bundle or card at the path of something that the card is made from."""
    path = Path(arguments.output)
    results = [pair.rpartition("=")[2] for pair in arguments.beside]
    read = [arguments.results, *results, path.with_suffix(".notes.md")]
    output.check_apart(read, [*more, path.with_suffix(".md")])


def _card(arguments, saved, sha256):
    import onnx

    from . import acceptance, card, contract

    metadata = contract.properties(onnx.load(arguments.output))
    beside = []
    for pair in arguments.beside:
        label, equals, path = pair.rpartition("=")
        if not equals:
            raise UserError(f"--beside {pair!r}: must be LABEL=FILE")
        beside.append((label, card.read_results(path)))
    results = card.read_results(arguments.results) if arguments.results else None
    path = Path(arguments.output).with_suffix(".md")
    notes = Path(arguments.output).with_suffix(".notes.md")
    notes = notes.read_text(encoding="utf-8") if notes.is_file() else ""
    output.write_atomically(path, card.write(arguments.run, saved, sha256, metadata, results, beside, notes, acceptance.beside(arguments.output)).encode())
    print(f"{path}: model card")


def _export(arguments):
    from . import acceptance, bundle, systems, training, tuning

    _check_card(arguments, [arguments.output])
    saved, setting = training.load_run(arguments.run, *arguments.system)
    encoded = _encode(setting)
    identity = saved["identity"]
    if encoded.sha256 != identity["language_sha256"]:
        raise UserError(f"{arguments.run} was trained with other weights of {encoded.encoder}")
    system = systems.of(setting.config)
    networks = system.Networks(setting, encoded)
    training.load_networks(networks, saved["networks"], arguments.run)
    names = system.Training.stages(setting.config)
    provenance = {
        "dataset_sha256": identity["dataset_sha256"],
        "seed": identity["seed"],
        "steps": {name: system.Training.settings(setting.config, name).steps for name in names},
    }
    arrays = lambda seen: {name: rows.numpy() for name, rows in seen.items()} if isinstance(seen, dict) else seen.numpy()
    candidates = ((instruction, arrays(seen)) for instruction, seen in saved["golden"])
    model = bundle.assemble(networks, setting, encoded, provenance, candidates)
    calibrated = acceptance.beside(arguments.output)
    if calibrated:
        acceptance.into(model, calibrated)
    sha256 = bundle.save(model, arguments.output)
    print(f"{arguments.output}: sha256 {sha256}")
    print(tuning.beside(arguments.output, sha256, arguments.lads_run))
    _card(arguments, saved, hashlib.sha256(Path(arguments.output).read_bytes()).hexdigest())


def _card_alone(arguments):
    from . import training

    _check_card(arguments, [])
    saved, _ = training.load_run(arguments.run)
    if not Path(arguments.output).is_file():
        raise UserError(f"no bundle at {arguments.output}; export one first (make export)")
    _card(arguments, saved, hashlib.sha256(Path(arguments.output).read_bytes()).hexdigest())


def _reference(arguments):
    from . import reference

    output.check_apart([arguments.model], [arguments.output, f"{arguments.output}.progress"])
    if arguments.complete:
        from . import questions

        questions.complete(arguments.model, arguments.output, arguments.run, arguments.system, arguments.lads_run)
        print(f"{arguments.output}: completed; next: lads-run verify --model {arguments.model} --reference {arguments.output}")
        return
    chosen = {key: getattr(arguments, key) for key in ("run", "episodes", "traced", "seed", "noise", "lads_run")}
    reference.write(arguments.model, arguments.output, over=arguments.system, **chosen)
    print(f"{arguments.output}: written; next: lads-run verify --model {arguments.model} --reference {arguments.output}")


def _upgrade(arguments):
    from . import upgrade

    if arguments.output:
        output.check_apart([arguments.environment], [arguments.output])
    print(upgrade.write(arguments.model, arguments.output, arguments.environment))


def _language(arguments):
    from . import language_graph

    folder = Path(arguments.output) if arguments.output else language_graph.default_folder(arguments.encoder)
    print(f"{folder}: {'written' if language_graph.write(arguments.encoder, folder) else 'up to date'}")


def _calibrate(arguments):
    from . import acceptance, config

    output.check_apart([config.find(arguments.config), config.find(arguments.sentences)], [arguments.output])
    setting = config.load(arguments.config)
    calibrated = acceptance.calibrate(setting, acceptance.read_sentences(config.find(arguments.sentences), setting))
    acceptance.write(calibrated, arguments.output)
    print("\n".join(acceptance.lines(calibrated)))
    print(f"{arguments.output}: written")


def _table(arguments):
    from .tables import run

    chosen = {key: getattr(arguments, key) for key in ("data", "frames", "features", "runs", "lads_run", "models", "engine", "device")}
    _device(arguments.device)
    if not run.run(arguments.table, at_once=arguments.jobs, **chosen):
        print("stopped; the same command goes on", file=sys.stderr)
        return 130
    print(f"{arguments.models}/TABLES.md: written")
    return 0


def _parser():
    parser = argparse.ArgumentParser(prog="python -m lads_exporter", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    random = commands.add_parser("random", help="a bundle with random weights, for tests")
    network = random.add_mutually_exclusive_group(required=True)
    network.add_argument("--config", help="a LADS policy of this configuration")
    network.add_argument("--kind", help="a small policy of a kind in lads_exporter/kinds; another word is refused with the list of them")
    random.add_argument("-o", "--output", required=True)
    random.add_argument("--seed", type=_seed, default=0)
    random.add_argument("--rendering", metavar="FILE", help="how the frames are drawn that a configuration's policy sees, as lads-run frames --rendering takes it")
    random.set_defaults(run_command=_random)

    episode = commands.add_parser("episode", help="a made-up episode of a bundle and what it does there, for tests of the runtime")
    episode.add_argument("model", metavar="MODEL", help="the bundle")
    episode.add_argument("-o", "--output", required=True, help="the .safetensors file; lads_exporter/episode.py says what is in it")
    episode.add_argument("--steps", type=int, default=200)
    episode.add_argument("--seed", type=_seed, default=0)
    episode.set_defaults(run_command=_episode)

    growth = commands.add_parser("growth", help="random bundles in which one dimension grows, for the benchmarks")
    growth.add_argument("--config", required=True, help="the sizes of everything else")
    growth.add_argument("-o", "--output", required=True, help="the folder to write them to")
    growth.add_argument("--seed", type=_seed, default=0)
    growth.set_defaults(run_command=_growth)

    seen = commands.add_parser("features", help="what a frozen encoder makes of every state of a dataset, drawn by lads-run; goes on where it was stopped")
    seen.add_argument("--config", required=True, help="a setting with [pretrained], such as exporter/configs/kitchen-image.toml")
    seen.add_argument("--system", action="append", default=[], metavar="FILE", help="values over those of --config, as train has it")
    seen.add_argument("--data", required=True, help="the dataset")
    seen.add_argument("-o", "--output", required=True, help="the file to write; what is done so far lies beside it, in FILE.parts")
    seen.add_argument("--lads-run", default="target/release/lads-run", help="the program that draws, built with --features camera (target/release/lads-run)")
    seen.add_argument("--threads", type=int, default=0, help="threads that draw; 0 is one per core")
    seen.set_defaults(run_command=_features)

    train = commands.add_parser("train", help="train a policy from a dataset")
    train.add_argument("--config", required=True, help="one TOML file per setting, in exporter/configs")
    train.add_argument("--system", action="append", default=[], metavar="FILE", help="values of a system over those of --config, such as configs/kitchen/lisa.toml")
    train.add_argument("--data", required=True, help=".safetensors of lads-collect, or D4RL kitchen .hdf5")
    train.add_argument("--frames", metavar="FILE", help="frames of the dataset, made by lads-run frames, for a setting with a camera")
    train.add_argument("--encoder", metavar="FILE", help="the encoder of frames that several systems share: taken from there instead of its stage, or put there after it")
    train.add_argument("--features", metavar="FILE", help="features of the dataset's frames, made by the command features, for a setting with a frozen encoder")
    train.add_argument("--out", required=True, help="folder of the run: checkpoint, curves, summary")
    train.add_argument("--resume", action="store_true", help="continue from the run's checkpoint")
    train.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    train.add_argument("--seed", type=_seed, default=0)
    train.add_argument("--threads", type=int, default=0, help="CPU threads; 0 leaves the choice to PyTorch")
    train.set_defaults(run_command=_train)

    export = commands.add_parser("export", help="a trained run to a bundle and its model card")
    card = commands.add_parser("card", help="write the model card again, with results")
    for command, function in ((export, _export), (card, _card_alone)):
        command.add_argument("--run", required=True)
        command.add_argument("-o", "--output", required=True, help="the bundle; the card lies beside it")
        command.add_argument("--results", help="JSON of lads-run --json for this bundle")
        command.add_argument("--beside", action="append", default=[], metavar="LABEL=FILE", help="results of another run")
        command.set_defaults(run_command=function)
    export.add_argument("--lads-run", default="target/release/lads-run", help="tunes the bundle by the reference beside it (target/release/lads-run)")
    export.add_argument("--system", action="append", default=[], metavar="FILE", help="export as this system's values say: its sampler or rule of decision")

    rollouts = commands.add_parser("reference", help="reference rollouts: PyTorch in the official environment, for lads-run verify")
    rollouts.add_argument("--model", required=True, help="the bundle whose policy is rolled out")
    rollouts.add_argument("-o", "--output", required=True)
    rollouts.add_argument("--run", help="take the weights from this run's checkpoint, not from the bundle's initializers; needed for systems other than LADS, whose layers are folded")
    rollouts.add_argument("--system", action="append", default=[], metavar="FILE", help="what the bundle was exported with, as export has it")
    rollouts.add_argument("--episodes", type=int, default=20, help="of each instruction (20)")
    rollouts.add_argument("--traced", type=int, default=2, help="of these, so many with all actions and the first states (2)")
    rollouts.add_argument("--seed", type=_seed, default=0)
    rollouts.add_argument("--complete", action="store_true", help="add to the reference that is there what an earlier version did not record")
    rollouts.add_argument("--noise", default="v0", help="observation noise: v0, v1 or none")
    rollouts.add_argument("--lads-run", default="target/release/lads-run", help="draws the frames of a policy with a camera (target/release/lads-run)")
    rollouts.set_defaults(run_command=_reference)

    upgraded = commands.add_parser("upgrade", help="a bundle of contract version 1 to version 2; graphs and weights stay as they are")
    upgraded.add_argument("model", metavar="MODEL", help="the bundle")
    upgraded.add_argument("-o", "--output", help="the file to write; left out, MODEL and what names its sha256 beside it")
    upgraded.add_argument("--environment", metavar="FILE", help="says what an action means; left out, the one in exporter/configs of the bundle's environment")
    upgraded.set_defaults(run_command=_upgrade)

    spoken = commands.add_parser("language", help="the language encoder as ONNX, so that lads-run takes any sentence")
    spoken.add_argument("--encoder", default="all-MiniLM-L6-v2", help="as in a config's language.encoder (all-MiniLM-L6-v2)")
    spoken.add_argument("-o", "--output", help="the folder; left out, language/ENCODER in $LADS_CACHE, else in the user's cache folder")
    spoken.set_defaults(run_command=_language)

    calibrate = commands.add_parser("calibrate", help="how like a known instruction a free sentence must be to be followed")
    calibrate.add_argument("--config", required=True, help="the policy's configuration")
    calibrate.add_argument("--sentences", required=True, help="sentences that ask for what the policy knows, and others: configs/*.sentences.json")
    calibrate.add_argument("-o", "--output", required=True, help="models/NAME.acceptance.json; `export` takes the one beside the bundle")
    calibrate.set_defaults(run_command=_calibrate)

    table = commands.add_parser("table", help="the paper's tables: trains, exports and evaluates every system; goes on where it was stopped")
    table.add_argument("table", metavar="TABLE", help="exporter/tables/kitchen.toml or another of that folder")
    table.add_argument("--data", help="the dataset; left out, the one that the table names")
    table.add_argument("--frames", help="the frames of the dataset's states, for systems with a camera; left out, those that the table names")
    table.add_argument("--features", help="the features of the dataset's frames, for systems with a frozen encoder; left out, those that the table names")
    table.add_argument("--runs", default="runs/tables", help="where jobs are kept (runs/tables)")
    table.add_argument("--lads-run", default="target/release/lads-run", help="the built program (target/release/lads-run)")
    table.add_argument("--models", default="models", help="where TABLES.md and tables.json go (models)")
    table.add_argument("--jobs", type=int, help="trainings at a time, of one thread each; left out, 1, and with ray one for each CPU of the cluster")
    table.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="what trainings run on (cpu); their sums differ between devices")
    table.add_argument("--engine", choices=("local", "ray"), default="local", help="where jobs run: on this machine, or on the Ray cluster at $RAY_ADDRESS, without it on a Ray of this machine's own (docs/cluster.md)")
    table.set_defaults(run_command=_table)
    return parser


def main():
    arguments = _parser().parse_args()
    try:
        return arguments.run_command(arguments) or 0
    except (UserError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
