"""The systems of the paper's tables, each a module of three things:

| name | what |
|---|---|
| `Networks(setting, encoded)` | all its networks as one `nn.Module` with a `normalizer`, what a checkpoint holds |
| `Training(networks, corpus, setting, seed_of)` | how they learn: stages, losses, validation (`base.Training`) |
| `export(networks, setting, encoded)` | the entry graphs and what the contract says of the family (`base.Exported`) |

What they share stands once: blocks of networks in `model`, the context's words and cuts in `contexts`, the vector quantiser in `codebook`, data
in `corpus`, stages and checkpoints in `training`, entry graphs in `graphs` and `kinds`. A system's hyper-parameters are `[system]` in its configuration.
"""

from importlib import import_module

MODULES = {
    "lads": "lads",
    "vae": "vae",
    "cluster": "cluster",
    "lang_dt": "lang_dt",
    "lisa": "lisa",
    "lcsd": "lcsd",
    "skilldiffuser": "skilldiffuser",
}


def of(config):
    """Returns the module of the system that a configuration names."""
    module = import_module(f".{MODULES[config.system.kind]}{'_history' if config.history.window else ''}", __name__)
    eyes = "sighted" if config.images.channel else "frozen" if config.pretrained.encoder else None
    return import_module(f".{eyes}", __name__).of(module) if eyes else module
