"""Command line: `python -m lads_exporter random|train|export`."""

import argparse
import sys

from .config import UserError


def _random(arguments):
    from . import bundle, config, language, random_policy

    setting = config.load(arguments.config)
    encoded = language.encode(setting.config.language, [row["text"] for row in setting.instructions])
    _, model = random_policy.export(setting, encoded, arguments.seed)
    sha256 = bundle.save(model, arguments.output)
    print(f"{arguments.output}: random weights, sha256 {sha256}")


def _parser():
    parser = argparse.ArgumentParser(prog="lads_exporter", description=__doc__)
    commands = parser.add_subparsers(required=True)
    random = commands.add_parser("random", help="a bundle with random weights, for tests")
    random.add_argument("--config", required=True)
    random.add_argument("-o", "--output", required=True)
    random.add_argument("--seed", type=int, default=0)
    random.set_defaults(run=_random)
    return parser


def main():
    arguments = _parser().parse_args()
    try:
        arguments.run(arguments)
    except (UserError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
