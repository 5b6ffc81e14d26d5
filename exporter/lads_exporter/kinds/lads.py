"""Kind `lads`: a random policy of the exporter's own system, exported by the code that exports trained ones."""

from .. import config, graphs, random_policy
from ..model import Lads
from . import common


def setting(sizes):
    """Makes the tiny configuration on the bench, with the given sizes."""
    table = config.read_toml("configs/tiny.toml")
    table["name"] = "random lads"
    table["language"] |= {"encoder": common.WORDS.encoder}
    table["high_level"] |= {"hidden": sizes.hidden, "layers": sizes.layers, "heads": sizes.heads, "context_steps": sizes.steps}
    table["low_level"] |= {"hidden": sizes.hidden, "layers": 4}
    table["encoder"] |= {"hidden": 16, "horizon": sizes.horizon, "codebook_size": sizes.codes, "codebook_dim": sizes.plan}
    instructions = {}
    for row in common.INSTRUCTIONS:
        instructions.setdefault(row["split"], []).append({key: row[key] for key in ("id", "text", "sub_tasks")})
    return config.from_tables(table, common.ENVIRONMENT, instructions, "random lads")


def policy(sizes, seed):
    made = setting(sizes)
    lads = Lads(made, common.WORDS)
    random_policy.randomize(lads, made, seed)
    return lads.eval()


def build(policy, sizes):
    return graphs.build(policy, common.WORDS, sizes.horizon)


def contract(sizes, seed):
    family = {"kind": "lads", "horizon": sizes.horizon, "codebook": sizes.codebook, "decision": common.argmax()}
    return common.contract(family, sizes, seed, segment=sizes.horizon)
