"""Makes policies of growing size with random weights, to measure what a control step costs as one dimension of the network grows.

Each series varies one dimension and keeps the others at those of the base configuration. The observations, the low level and the
language are the base's, but the language's words are random: no encoder has to be there.
"""

import copy
import json

from . import bundle, config, language, output, random_policy

SERIES = {
    "layers": [1, 2, 4, 8],
    "width": [64, 128, 256, 512],
    "codebook": [16, 64, 256, 1024],
    "actions": [3, 9, 27, 81],
}
STEPS = 160  # control steps of the context: enough for 300 tokens


def table_of(base, series, value):
    """Returns the base's configuration and environment with one dimension changed."""
    table, environment, instructions = copy.deepcopy(base.tables)
    table["name"] = f"{series}-{value}"
    table["language"] |= {"encoder": "random-384", "layer": -1, "pool": False}
    table["high_level"]["context_steps"] = STEPS
    table["encoder"]["hidden"] = 16  # it does not run in a control step
    if series == "layers":
        table["high_level"]["layers"] = value
    elif series == "width":
        table["high_level"]["hidden"] = table["low_level"]["hidden"] = value
    elif series == "codebook":
        table["encoder"]["codebook_size"] = value
    else:
        row = {"unit": "1", "min": -1.0, "max": 1.0, "joint": "", "scale": 1.0}
        environment["action"] = [{"name": f"action_{i}", **row} for i in range(value)]
    # One instruction is enough; every word of it is another random row.
    instructions = {"seen": instructions["seen"][:1]}
    table["data"]["weights"] = {}
    return table, environment, instructions


def export(base, folder, seed=0, steps=40):
    """Writes one bundle per point and index.json, which lists them as [series, value, file]. Yields as it goes."""
    folder.mkdir(parents=True, exist_ok=True)
    index = []
    for series, values in SERIES.items():
        for value in values:
            setting = config.from_tables(*table_of(base, series, value), "growth")
            encoded = language.encode(setting.config.language, [row["text"] for row in setting.instructions])
            _, model = random_policy.export(setting, encoded, seed, steps)
            name = f"{series}-{value}.onnx"
            bundle.save(model, folder / name)
            index.append([series, value, name])
            yield name
    output.write_atomically(folder / "index.json", json.dumps(index).encode())
