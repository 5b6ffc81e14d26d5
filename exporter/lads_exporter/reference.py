"""Makes reference rollouts: the PyTorch policy in the official environment, for `lads-run verify` to compare with.

What is independent of what is verified: the network runs as in training, in PyTorch, as a full-sequence forward over the
whole history at every decision (`whole`: no KV cache, no ONNX graph, no compiler, no Rust); the physics, the observations and the
task checks are the official environment's; the words are encoded anew from the instructions' texts where the language
encoder is installed. What is not: the weights of a LADS policy come from the bundle's initializers unless `--run` names the checkpoint, and
then the normaliser's scale and batch norm are those that the exporter folded; the noise, of observations and of a policy that draws, is that of
the runtime's streams, so that it can run the very same episodes.

The policy sees observations as float32 and acts with float32, as the runtime does. Frames of a policy with a camera are drawn of the
official environment's states by the harness's renderer, so that both sides see by the same one; a trace holds the states, and of
every frame a digest, by which a verifier knows whether it draws the same. What such a policy observes of the state beside its frames is recorded as
any observation is: the first elements of it. An interrupted run continues from its progress file, which lies beside the output until that is complete.
"""

import base64
import hashlib
import json
import os
import platform
import struct
from pathlib import Path

import numpy as np
import onnx
import torch
from tqdm import tqdm

from . import __version__, config, contract as contracts, frames, language, official, questions, whole
from .output import write_atomically

FORMAT, FORMAT_VERSION = "lads-reference", 2
TRACED_STATES = 50
# What a policy is for; the rest of a contract says how it is built, which is what a verification compares. Of the channels, those that
# the environment gives and takes; of the language, what makes words of a sentence, and not which sentences are refused.
PURPOSE = ("environment", "control_period_s", "channels", "instructions", "language", "evaluation")
PURPOSE_ROLES = ("observation", "action")


def untuned_sha256(model):
    """Computes the sha256 of a bundle as it was before `lads-run tune`, which names a reference of it in what it adds."""
    before = onnx.ModelProto()
    before.CopyFrom(model)
    del before.metadata_props[:]
    before.metadata_props.extend(row for row in model.metadata_props if row.key != contracts.STORAGE_KEY)
    return hashlib.sha256(before.SerializeToString()).hexdigest()


def purpose_sha256(contract):
    """Hashes what the contract says the policy is for: equal for two policies that can be compared.

    Canonical form: `{key value ...}` with sorted keys, `[value ...]`, texts as `"bytes:UTF-8`, numbers as the 16 hexadecimal
    digits of their IEEE 754 double, `true`, `false` and `null`; no separators, so that nothing depends on how a number is
    printed.
    """
    digest = hashlib.sha256()

    def add(value):
        if isinstance(value, dict):
            digest.update(b"{")
            for key in sorted(value):
                add(key)
                add(value[key])
            digest.update(b"}")
        elif isinstance(value, list):
            digest.update(b"[")
            for row in value:
                add(row)
            digest.update(b"]")
        elif isinstance(value, str):
            text = value.encode()
            digest.update(b'"%d:' % len(text) + text)
        elif value is None or isinstance(value, bool):
            digest.update({None: b"null", True: b"true", False: b"false"}[value])
        else:
            digest.update(struct.pack(">d", value).hex().encode())

    purpose = {key: contract[key] for key in PURPOSE if key in contract}
    purpose["channels"] = [row for row in contract["channels"] if row["role"] in PURPOSE_ROLES]
    if "language" in purpose:
        purpose["language"] = {key: value for key, value in purpose["language"].items() if key != "acceptance"}
    add(purpose)
    return digest.hexdigest()


def episode(policy, environment, entropy, instruction, known, traced, renderer=None):
    """Runs one episode -> a JSON object; it ends when the instruction is carried out or its split's steps are up."""
    seed = whole.noise_seed(entropy) if policy.seeded else None
    policy.start(instruction, seed)
    commanded, most = known["sub_tasks"], environment.max_steps(known["split"])
    observation = environment.reset(entropy, commanded)
    vector, camera = contracts.seen(policy.contract)
    states, observations, digests, actions = [], [], [], []
    while environment.steps < most and not environment.succeeded(commanded):
        if traced and (renderer or len(states) < TRACED_STATES):
            states.append(environment.state())
        seen = {}
        if vector:
            seen[vector["name"]] = observation[: vector["shape"][0]].astype(np.float32)
            observations.append(seen[vector["name"]])
        if camera:
            seen[camera["name"]] = renderer.draw(environment.state()).copy()
            digests.append(frames.digest(seen[camera["name"]]))
        action = policy.act(seen)
        actions.append(action)
        observation = environment.step(action.astype(np.float64))
    order = sorted(environment.completions.items(), key=lambda row: (row[1], environment.SUB_TASKS.index(row[0])))
    row = {
        "episode": entropy[2],
        "steps": environment.steps,
        "success": environment.succeeded(commanded),
        "completions": [{"sub_task": task, "step": step} for task, step in order],
        "plans": policy.plans,
        "margins": [round(margin, 6) for margin in policy.margins],
        "decided_at": policy.decided_at,
        "final_state": environment.state().tolist(),
    }
    if traced:
        text = lambda rows, kind: base64.b64encode(np.stack(rows).astype(kind).tobytes()).decode()
        # What the policy saw and did at every step, so that a verifier can ask another policy the same questions; and the
        # noise-free states that the environment's physics is compared by. Frames are made of the states of all steps.
        seen = {"observations": text(observations, "<f4") if vector else ""}
        if camera:
            seen["frames"] = text(digests, "u1")
        row["trace"] = seen | {"actions": text(actions, "<f4"), "states": text(states, "<f8")}
        if policy.vectors:
            row["trace"]["plan_vectors"] = text(policy.vectors, "<f4")
    return row if seed is None else row | {"noise_seed": seed}


def _words(model, contract):
    """Encodes the instructions -> one tensor [L, E] each, where they come from, and the largest difference to the bundle's table."""
    stored = {row.name: onnx.numpy_helper.to_array(row) for row in model.graph.initializer if "instruction." in row.name}
    table, lengths = stored["weights/instruction.words"], stored["constants/instruction.lengths"]
    rows = [torch.from_numpy(table[index, :length].copy()) for index, length in enumerate(lengths)]
    facts = contract["language"]
    try:
        encoded = language.encode(config.Language(facts["encoder"], facts["layer"], facts.get("pooling") == "mean"), [row["text"] for row in contract["instructions"]])
    except (config.UserError, ImportError):
        return rows, "the bundle's table", None
    if encoded.sha256 != facts["sha256"]:
        return rows, "the bundle's table", None
    anew = [torch.from_numpy(row.words) for row in encoded.instructions]
    difference = max(float((a - b).abs().max()) for a, b in zip(anew, rows, strict=True))
    return anew, "the language encoder", difference


class Progress:
    """File of finished episodes beside the output, one JSON line each under a heading that says of what."""

    def __init__(self, output, heading):
        self.path = Path(f"{output}.progress")
        self.done = {}
        heading = json.dumps(heading, sort_keys=True)
        lines = self.path.read_text().splitlines() if self.path.exists() else []
        if lines and lines[0] == heading:
            for line in lines[1:]:
                try:
                    instruction, row = json.loads(line)
                except ValueError:
                    break  # the line that was being written when the run ended
                self.done[instruction, row["episode"]] = row
        # Written anew, so that half a line at the end does not stay.
        kept = [json.dumps([key[0], row]) for key, row in self.done.items()]
        write_atomically(self.path, "".join(f"{line}\n" for line in [heading, *kept]).encode())
        self.file = self.path.open("a")

    def add(self, instruction, row):
        self.done[instruction, row["episode"]] = row
        self.file.write(json.dumps([instruction, row]) + "\n")
        self.file.flush()

    def finish(self):
        self.file.close()
        os.unlink(self.path)


def _text(head, instructions):
    """Formats JSON with one line per episode."""
    dump = lambda value: json.dumps(value, ensure_ascii=False)
    lines = ["{"]
    lines += [f" {dump(key)}: {dump(value)}," for key, value in head.items()]
    lines.append(' "instructions": [')
    for place, row in enumerate(instructions):
        episodes = row.pop("episodes")
        lines.append("  " + dump(row)[:-1] + ', "episodes": [')
        lines.append(",\n".join("   " + dump(episode) for episode in episodes))
        lines.append("  ]}" + ("," if place + 1 < len(instructions) else ""))
    return "\n".join([*lines, " ]", "}", ""])


def renderer_of(contract, lads_run):
    """Makes the renderer of the policy's camera; None for a policy without."""
    _, camera = contracts.seen(contract)
    if camera is None:
        return None
    if "rendering" not in camera:
        raise config.UserError(f"channel {camera['name']}: the contract does not say how its frames are drawn; export the policy with the frames of lads-run")
    return frames.Renderer(lads_run, contract["environment"]["id"], camera["rendering"])


def write(bundle, output, run=None, over=(), episodes=20, traced=2, seed=0, noise="v0", lads_run="target/release/lads-run"):
    """Rolls out all instructions of `bundle` and writes the reference to `output`.

    `run` is the training that the bundle was exported from, `over` the files of a system's values that it was exported with; `lads_run` draws
    what a policy with a camera sees.
    """
    if episodes < 1 or not 1 <= traced <= episodes:
        raise config.UserError(f"{episodes} episodes of which {traced} traced: give at least 1 of each, and no more traced than episodes")
    if not 0 <= seed < 1 << 64:
        raise config.UserError(f"--seed {seed}: must be a whole number from 0 to 2^64 - 1")
    if Path(output).is_dir() or not Path(output).absolute().parent.is_dir():
        raise config.UserError(f"{output}: it is a folder, or lies in none; name a file in a folder that is there")
    data = Path(bundle).read_bytes()
    try:
        model = onnx.load_from_string(data)
    except Exception as error:
        raise config.UserError(f"{bundle}: not a bundle with a contract ({type(error).__name__}); export one first") from error
    contract = contracts.of(model, bundle)
    if "codebook" in contract["family"] and contracts.rule(contract) != "argmax":
        raise config.UserError(f"{bundle}: plans are decided by {contracts.rule(contract)}; a reference needs argmax")
    make = official.ENVIRONMENTS.get(contract["environment"]["id"])
    if make is None:
        raise config.UserError(f"{bundle}: no official environment for {contract['environment']['id']!r}")
    torch.set_num_threads(1)  # sums depend on their number
    renderer = renderer_of(contract, lads_run)
    environment = make(noise)
    words, words_from, words_difference = _words(model, contract)
    policy, weights_from = whole.of(model, contract, words, run, over)
    known = contracts.splits(contract)
    head = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "bundle_sha256": untuned_sha256(model),
        "purpose_sha256": purpose_sha256(contract),
        "environment": {"id": environment.ID, "version": environment.VERSION, "max_steps": max(environment.max_steps(row["split"]) for row in known)},
        "seed": seed,
        "noise": noise,
        "decision": contracts.rule(contract),
        "horizon": contracts.period(contract) if "codebook" in contract["family"] else None,
        "episodes_per_instruction": episodes,
        "traced_episodes": traced,
        "weights_from": weights_from,
        "words_from": words_from,
        "words_difference": words_difference,
        "versions": {
            "lads-exporter": __version__,
            "python": platform.python_version(),
            "numpy": np.__version__,
            "torch": torch.__version__,
            **environment.versions(),
        },
    }
    if renderer:
        head["renderer"] = renderer.versions
    progress = Progress(output, head)
    with tqdm(total=len(known) * episodes, initial=len(progress.done), unit="episode") as bar:
        for number in range(episodes):
            for index, instruction in enumerate(known):
                if (index, number) in progress.done:
                    continue
                entropy = [seed, index, number]
                progress.add(index, episode(policy, environment, entropy, index, instruction, number < traced, renderer))
                bar.update()
    environment.close()
    rows = [
        {key: row[key] for key in ("id", "text", "split", "sub_tasks")} | {"episodes": [progress.done[index, n] for n in range(episodes)]}
        for index, row in enumerate(known)
    ]
    questions.add(head, rows, model, contract, policy, renderer)
    if renderer:
        renderer.close()
    text = _text(head, rows)
    write_atomically(output, text.encode())
    progress.finish()
    return rows
