"""The configuration of one setting: one TOML file, every hyper-parameter in it, no hidden defaults.

A file that lacks a key or has one that nothing reads is refused with the key's name, so that a typing
error cannot silently train something else. Paths in the file are relative to the file.
"""

import dataclasses
import json
import tomllib
from dataclasses import dataclass
from pathlib import Path


class UserError(Exception):
    """An error that the user can put right; ends the command with this one line and exit code 2."""


@dataclass(frozen=True)
class Language:
    encoder: str  # "all-MiniLM-L6-v2", the folder of a BERT-family model, or "random-<dim>" for tests
    layer: int  # which hidden layer gives the word embeddings; -1 is the last (the paper's)
    pool: bool  # one word per instruction, the mean of the last layer; false is the paper's


@dataclass(frozen=True)
class HighLevel:
    hidden: int
    layers: int
    heads: int
    dropout: float
    context_steps: int  # rows of the timestep embedding; longer trajectories are cut where the controller restarts its context
    balance: float  # times the log frequency of each plan is taken off its logit after training; 0 is the paper's


@dataclass(frozen=True)
class LowLevel:
    hidden: int
    layers: int  # linear layers; batch norm on all but the first and the last
    slope: float  # of LeakyReLU
    gain: float  # the trained low level's actions are multiplied by this; 1 is the paper's


@dataclass(frozen=True)
class Encoder:
    hidden: int
    observed: int  # the encoder sees the first so many observation elements; 0 is all of them (the paper's)
    relative: bool  # it sees how the observation changed since the segment's first step; false is the paper's
    horizon: int  # H, control steps per plan
    codebook_size: int  # M
    codebook_dim: int  # D
    commitment: float  # beta of equation 6
    ema: float
    revive_below: float  # a code used less than this fraction of the mean use is replaced
    kmeans_step: int  # optimiser steps before the codebook is started by k-means++


@dataclass(frozen=True)
class Alignment:
    weight: float  # lambda_align of equation 11
    hidden: int
    layers: int
    heads: int
    dropout: float
    out: int
    segments: int  # plans of the longest trajectory that is aligned
    segment_dropout: float  # probability with which a plan is left out of the sequence that is aligned; 0 is the paper's


@dataclass(frozen=True)
class Stage:
    steps: int
    batch: int  # trajectories; transitions in the low-level stage
    learning_rate: float
    warmup: int
    final: float  # the cosine ends at this fraction of the learning rate; 1 keeps it constant
    weight_decay: float


@dataclass(frozen=True)
class Images:
    """Camera of a policy that observes images instead of the state; the paper's encoder is LISA's."""

    channel: str  # name of the camera's channel; "" for a policy that observes the state
    widths: list  # channels of the convolutions
    hidden: list  # units of the dense layers behind them
    features: int  # what they come to
    state_weight: float  # of the loss by which the features tell the state in the stage plans; 0 is the paper's
    jitter: float  # of brightness, contrast, saturation and hue, drawn for each trajectory
    turn_degrees: float
    shift: float  # share of the frame's sides
    scale: float
    frames: Stage  # the encoder alone, by the states that single frames show; without steps it learns in the stage plans, end to end as the paper's


NO_STAGE = {"steps": 0, "batch": 0, "learning_rate": 0.0, "warmup": 0, "final": 0.0, "weight_decay": 0.0}
NO_IMAGES = {"channel": "", "widths": [], "hidden": [], "features": 0, "state_weight": 0.0, "jitter": 0.0, "turn_degrees": 0.0, "shift": 0.0, "scale": 0.0, "frames": NO_STAGE}


@dataclass(frozen=True)
class Pretrained:
    """Features of a frozen encoder that a policy sees beside the first elements of the state; `encoders` lists the encoders."""

    channel: str  # name of the camera's channel
    encoder: str  # "" for a policy without
    features: int  # what the encoder gives
    joints: int  # the first so many elements of the state are observed beside them
    std_floor: float  # features are z-scored with max(std, std_floor times the median std)
    clip: float  # and clipped to so many standard deviations


NO_PRETRAINED = {"channel": "", "encoder": "", "features": 0, "joints": 0, "std_floor": 0.0, "clip": 0.0}


@dataclass(frozen=True)
class History:
    """A causal transformer as low level, over the plan, a window of earlier steps and those of the plan."""

    window: int  # W, earlier steps; 0 for a policy whose low level is an MLP
    layers: int
    heads: int
    dropout: float


NO_HISTORY = {"window": 0, "layers": 0, "heads": 0, "dropout": 0.0}


@dataclass(frozen=True)
class Data:
    std_floor: float  # observations are z-scored with max(std, std_floor)
    validation_every: int  # every n-th episode is held out
    weights: dict  # instruction id -> sampling weight; others 1
    action_mask: list  # 0 for elements of the action without effect, which are learned as 0; empty for none
    hindsight: int  # train on so many relabelled parts of the trajectories (lads_exporter/hindsight.py); 0 is the paper's
    hindsight_latest: int  # the last step that a part starts at
    hindsight_most: int  # sub-tasks per label at most
    renoise: bool  # draw fresh observation noise on the clean states while the low level trains
    word_noise: float  # Gaussian noise on the words while the high level trains, relative to their size
    word_dropout: float  # probability with which a word token is left out of the high level's prefix
    ending_rate: float  # share of the high level's trajectories that get an instruction with another ending; 0 is the paper's
    ending_variants: int  # other endings per beginning
    ending_margin: float  # with k of n phrases kept, steps before (k - margin) / n of the trajectory count


@dataclass(frozen=True)
class Training:
    schedule: str  # "joint" (Algorithm 1) or "staged"
    clip: float  # gradient norm
    bc_weight: float  # on the mean squared error per action element
    random_offset: bool  # start the segmentation of a trajectory at a random step below H
    ce_at: str  # "all" window starts, or "decisions" (multiples of H) only
    bf16: bool  # bfloat16 in the transformer and in matrix products where the CPU or GPU has it
    joint: Stage
    plans: Stage  # staged 1: encoder, codebook, low level, alignment
    low_level: Stage  # staged 2: low level on frozen codes
    high_level: Stage  # staged 3: high level on frozen codes


@dataclass(frozen=True)
class Lads:
    kind: str
    regressed: bool  # the high level regresses the plan and the nearest code is taken (w/o CP); false classifies


@dataclass(frozen=True)
class Vae:
    kind: str
    beta: float  # weight of the divergence from the prior, per element
    rule: str  # which plan is taken: "mean", or "sample"


@dataclass(frozen=True)
class Cluster:
    kind: str
    points: int  # observations that are embedded in the plane
    perplexity: float  # of t-SNE


@dataclass(frozen=True)
class LangDt:
    kind: str


@dataclass(frozen=True)
class Lisa:
    kind: str
    low_level_layers: int
    option_gradient: str  # which of an option's H copies carry its gradient: "first" (the published code's), or "all"


@dataclass(frozen=True)
class Lcsd:
    kind: str
    hidden: int  # of the denoiser and of the instruction's reconstruction
    steps: int  # denoising passes
    language: float  # weight of the instruction's reconstruction from the plans
    average: float  # decay of the moving average of the denoiser's weights, which is what acts


@dataclass(frozen=True)
class SkillDiffuser:
    kind: str
    low_level_layers: int  # of the LISA that the high level comes from
    option_gradient: str
    width: int  # channels of the U-Net at its full length
    multiples: list  # of the width, one per length
    groups: int  # of the group norms
    inverse: int  # hidden units of the inverse dynamics
    schedule: int  # noise levels it is trained on
    dropout: float  # share of windows whose option is left out in training
    guidance: float
    temperature: float  # of the noise
    clip: float  # bound of the denoised rows
    average: float
    sampler: str  # "ddim", or "ddpm" over all levels
    passes: int  # denoising passes of the sampler
    diffusion: Stage  # the second stage; its batch is of windows


SYSTEMS = {"lads": Lads, "vae": Vae, "cluster": Cluster, "lang_dt": LangDt, "lisa": Lisa, "lcsd": Lcsd, "skilldiffuser": SkillDiffuser}
ACTING = ("sampler", "passes", "guidance", "temperature", "clip", "rule")  # of [system]: what trained weights do not depend on
ON_FEATURES = ("lads", "vae", "lang_dt", "lisa")  # systems that [pretrained] goes with
SEEING = ("lads", "vae", "lang_dt", "lisa")  # systems that [images] goes with
LADS = {"kind": "lads", "regressed": False}  # what a configuration without [system] trains


@dataclass(frozen=True)
class Config:
    name: str
    environment: str
    instructions: str
    decision: str  # "argmax" or "sample"
    beyond_context: str  # "restart" or "refuse"
    language: Language
    high_level: HighLevel
    low_level: LowLevel
    encoder: Encoder
    alignment: Alignment
    data: Data
    images: Images
    pretrained: Pretrained
    history: History
    training: Training
    system: object  # one of SYSTEMS

    @property
    def period(self):
        """Number of control steps from one plan to the next: a chunk of H states has H - 1 actions, and what has no plan or one at each
        step has 1."""
        return {"skilldiffuser": self.encoder.horizon - 1, "lcsd": 1, "lang_dt": 1}.get(self.system.kind, self.encoder.horizon)


def _system(table, where):
    kind = table.get("kind") if isinstance(table, dict) else None
    if kind not in SYSTEMS:
        raise UserError(f"{where}: kind = {kind!r}: unknown system; known: {', '.join(SYSTEMS)}")
    return _build(SYSTEMS[kind], table, where)


def _build(kind, table, where):
    if not isinstance(table, dict):
        raise UserError(f"{where} must be a table")
    fields = {field.name: field for field in dataclasses.fields(kind)}
    for key in table:
        if key not in fields:
            raise UserError(f"{where}: unknown key {key!r}; known: {', '.join(fields)}")
    values = {}
    for name, field in fields.items():
        if name not in table:
            raise UserError(f"{where}: key {name!r} is missing")
        value = table[name]
        if field.name == "system":
            value = _system(value, f"{where}[system]")
        elif dataclasses.is_dataclass(field.type):
            value = _build(field.type, value, f"{where}[{name}]")
        elif field.type is float and type(value) is int:
            value = float(value)
        elif type(value) is not field.type:
            raise UserError(f"{where}: {name} must be {field.type.__name__}, not {value!r}")
        values[name] = value
    return kind(**values)


def find(path):
    """Finds a file by its path, or the one of that name beside the package (so `configs/kitchen.toml` works anywhere)."""
    path = Path(path)
    beside = Path(__file__).resolve().parent.parent / path
    for candidate in (path, beside):
        if candidate.is_file():
            return candidate
    raise UserError(f"no such file: {path}; the configurations that ship are in exporter/configs")


def _parse(path, parser):
    try:
        return parser(path.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise UserError(f"{path}: {error}") from error


def read_toml(path):
    """Reads a TOML file as a table."""
    return _parse(find(path), tomllib.loads)


@dataclass(frozen=True)
class Setting:
    """A configuration with the environment and the instructions it names."""

    config: Config
    environment: dict
    instructions: list  # of {id, text, sub_tasks, split}, in the file's order
    tables: list  # what `from_tables` read, as plain data; stored in checkpoints
    rendering: dict | None = None  # how the frames are drawn that the policy sees

    @property
    def state_len(self):
        """Elements of the environment's own observation."""
        return len(self.environment["observation"])

    @property
    def observation_len(self):
        """Elements of what the networks observe: the state, or the features of a frame, with a frozen encoder's the joints first."""
        seen = self.config.pretrained
        return seen.joints + seen.features if seen.encoder else self.config.images.features or self.state_len

    @property
    def action_len(self):
        return len(self.environment["action"])


def from_tables(table, environment, instructions, where):
    """Checks the three tables of a setting against each other."""
    config = _build(Config, {"system": LADS, "images": NO_IMAGES, "pretrained": NO_PRETRAINED, "history": NO_HISTORY} | table, str(where))
    for name, value, allowed in (
        ("decision", config.decision, ("argmax", "sample")),
        ("beyond_context", config.beyond_context, ("restart", "refuse")),
        ("training.schedule", config.training.schedule, ("joint", "staged")),
        ("training.ce_at", config.training.ce_at, ("all", "decisions")),
        ("system.rule", getattr(config.system, "rule", "mean"), ("mean", "sample")),
        ("system.option_gradient", getattr(config.system, "option_gradient", "all"), ("first", "all")),
        ("system.sampler", getattr(config.system, "sampler", "ddim"), ("ddim", "ddpm")),
    ):
        if value not in allowed:
            raise UserError(f"{where}: {name} = {value!r}: must be one of {', '.join(allowed)}")
    plain = config.system.kind == "lads" and not config.system.regressed and config.training.schedule == "staged"
    _seen(config, plain, where)
    _frozen(config, len(environment.get("observation", [])), where)
    if config.high_level.hidden % config.high_level.heads:
        raise UserError("high_level.hidden must be a multiple of high_level.heads")
    steps, period = config.high_level.context_steps, config.period
    if period < 1 or steps < 1 or steps % period:
        raise UserError(
            f"{where}: high_level.context_steps = {steps} is not a multiple of the plan period of {period}"
            f" (encoder.horizon = {config.encoder.horizon}): where the context starts anew,"
            " a plan would begin off the grid that the policy was trained on"
        )
    for key in ("id", "version", "control_period_s", "quaternion_order", "observation", "action"):
        if key not in environment:
            raise UserError(f"{config.environment}: key {key!r} is missing")
    groups = ((split, group) for split, group in instructions.items() if isinstance(group, list))
    rows = [{**row, "split": split} for split, group in groups for row in group]
    if not rows:
        raise UserError(f"{config.instructions}: no instruction in it")
    mask = config.data.action_mask
    if mask and (len(mask) != len(environment["action"]) or any(value not in (0, 1) for value in mask)):
        raise UserError(f"{where}: data.action_mask must have a 0 or a 1 for each of {len(environment['action'])} elements")
    known = {row["id"] for row in rows}
    for name in config.data.weights:
        if name not in known:
            raise UserError(f"data.weights names {name!r}, which is not an instruction id of {config.instructions}")
    return Setting(config, environment, rows, [table, environment, instructions])


def _seen(config, plain, where):
    """Checks what goes with [images]: all problems at once."""
    if not config.images.channel:
        return
    problems = []
    if config.system.kind not in SEEING:
        problems.append(f"system {config.system.kind} does not see; those that do: {', '.join(SEEING)}")
    elif not config.images.frames.steps and not plain:
        problems.append("the encoder learns in the stage plans of LADS only; others need images.frames.steps above 0")
    if config.training.schedule != "staged":
        problems.append("schedule staged is needed")
    if config.data.renoise:
        problems.append("data.renoise is of states: false is needed")
    if problems:
        raise UserError(f"{where}: [images]: {'; '.join(problems)}")


def _frozen(config, state_len, where):
    """Checks [pretrained] and [history]: all problems at once."""
    seen, history, kind = config.pretrained, config.history, config.system.kind
    if not seen.encoder and not history.window:
        return
    problems, sizes = [], {"pretrained.features": seen.features}
    if kind not in ON_FEATURES:
        problems.append(f"they go with the systems {', '.join(ON_FEATURES)}, not {kind}")
    elif kind in ("lads", "vae") or history.window:
        sizes |= {f"history.{name}": getattr(history, name) for name in ("window", "layers", "heads")}
        if not seen.encoder or not history.window:
            problems.append(f"[pretrained] and [history] go together in system {kind}")
        if kind == "lang_dt":
            problems.append("system lang_dt has no low level: history.window = 0 is needed")
    if config.training.schedule != "staged" or config.images.channel:
        problems.append("they go with schedule staged and without [images]")
    problems += [f"{name} = {value} must be positive" for name, value in sizes.items() if value < 1]
    if not seen.channel:
        problems.append("pretrained.channel names no camera")
    if not 1 <= seen.joints <= state_len:
        problems.append(f"pretrained.joints = {seen.joints} must be 1 to {state_len}, the elements of the state")
    if seen.std_floor <= 0 or seen.clip <= 0:
        problems.append("pretrained.std_floor and pretrained.clip must be positive")
    if history.window and config.low_level.hidden % max(1, history.heads):
        problems.append("low_level.hidden must be a multiple of history.heads")
    if problems:
        raise UserError(f"{where}: {'; '.join(problems)}")


def changed(before, after, within=""):
    """Lists the dotted keys whose values differ between two tables."""
    if not (isinstance(before, dict) and isinstance(after, dict)):
        return [within] if before != after else []
    names = dict.fromkeys([*before, *after])
    return [row for name in names for row in changed(before.get(name), after.get(name), f"{within}.{name}" if within else name)]


def exported_with(table, path):
    """Layers a file over the table of a trained run, for an export; refuses one that changes what its weights depend on."""
    after = layered(table, read_toml(path))
    wrong = [key for key in changed(table.get("system", LADS), after.get("system", LADS), "system") if key.removeprefix("system.") not in ACTING]
    without = lambda whole: {key: value for key, value in whole.items() if key not in ("system", "decision", "beyond_context")}
    wrong += changed(without(table), without(after))
    if wrong:
        raise UserError(f"{path}: changes {', '.join(wrong)}, on which the trained weights depend; name the file that the run was trained with, or one that changes how it acts only")
    return after


def layered(table, over):
    """Layers a table over another: its values replace the other's; tables within it are layered, [system] is replaced."""
    both = {key: layered(table[key], value) for key, value in over.items() if key != "system" and isinstance(value, dict) and isinstance(table.get(key), dict)}
    return table | over | both


def files(path, *over):
    """Lists the files that `load` reads."""
    path = find(path)
    table = read_toml(path)
    return [path, *(find(path.parent / table[key]) for key in ("environment", "instructions")), *map(find, over)]


def load(path, *over):
    """Reads a configuration and the environment and instruction files it names; `over` are files of a system's own values."""
    path = find(path)
    table = _parse(path, tomllib.loads)
    beside = {}
    for key, parser in (("environment", tomllib.loads), ("instructions", json.loads)):
        name = table.get(key)
        if not isinstance(name, str):
            raise UserError(f"{path}: key {key!r} is missing")
        beside[key] = _parse(find(path.parent / name), parser)
    for one in over:
        table = layered(table, read_toml(one))
    where = " with ".join(str(one) for one in (path, *over))
    return from_tables(table, beside["environment"], beside["instructions"], where)
