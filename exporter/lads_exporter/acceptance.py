"""Calibrates which free sentences a policy follows: how like a known instruction a sentence must be, on sentences that people wrote.

The measure is `alignment`, the one of the runtime (runtime/core/src/similarity.rs): every word of the sentence is held against the word of the
known instruction that is most like it, by the cosine, and the mean over the words counts; the end mark is left out. The table of sentences has
some that ask for what the policy knows and some that do not. The threshold is the one at which the shares accepted of both differ most.

What it cannot do: it compares words, so a sentence made of known words is accepted whatever it says ("never turn on the bottom burner").
"""

import hashlib
import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from . import language
from .output import write_atomically
from .config import UserError

FORMAT, FORMAT_VERSION = "lads-acceptance", 1
SIMILARITY = "alignment"
LEAST = 40  # sentences of either sort in a table
SUFFIX = ".acceptance.json"
_LANGUAGE = ("encoder", "sha256", "dim", "layer", "pooling")


@dataclass(frozen=True)
class Sentence:
    """A sentence, and whether the policy knows what it asks for."""

    known: bool
    kind: str
    text: str


def alignment(sentence, known):
    """Computes the similarity of a sentence to a known instruction, from -1 to 1; both are words [n, E]."""
    directions = lambda words: words / np.maximum(np.linalg.norm(words, axis=1, keepdims=True), np.finfo(np.float32).tiny)
    spoken = lambda words: directions(np.asarray(words[:-1] if len(words) > 1 else words, np.float64))
    return float((spoken(sentence) @ spoken(known).T).max(1).mean())


def nearest(words, known):
    """Finds the known instruction that a sentence is most like: its index (the first of equal ones), and the similarity."""
    alike = [alignment(words, other) for other in known]
    index = int(np.argmax(np.round(alike, 6)))  # the last bits of a sum are no reason to prefer one
    return index, alike[index]


def read_sentences(path, setting):
    """Reads the table of sentences of a setting's environment."""
    try:
        table = json.loads(Path(path).read_text(encoding="utf-8"))
        rows = [Sentence(row["known"], row["kind"], row["text"]) for row in table["sentences"]]
        environment = table["environment"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}: not a table of sentences ({error!r})") from error
    if environment != setting.environment["id"]:
        raise UserError(f"{path}: sentences for {environment}, the configuration is for {setting.environment['id']}")
    texts = [row.text for row in rows]
    plain = lambda text: " ".join(text.lower().split())
    table = {plain(row["text"]) for row in setting.instructions}
    for text in texts:
        if texts.count(text) > 1 or plain(text) in table:
            raise UserError(f"{path}: {text!r} stands there twice or is an instruction of the policy's own table; leave it out")
    for known, what in ((True, "known"), (False, "not known")):
        count = sum(row.known is known for row in rows)
        if count < LEAST:
            raise UserError(f"{path}: {count} sentences that are {what}; at least {LEAST} are needed")
    return rows


def best_threshold(similarities, known):
    """Finds where the shares accepted of known and other sentences differ most, to three digits; the largest such threshold.

    Candidates lie half-way between neighbouring similarities, so that rounding decides about none of the sentences.
    """
    similarities, known = np.asarray(similarities, np.float64), np.asarray(known, bool)
    ordered = np.unique(similarities)
    best = (-2.0, 0.0)
    for threshold in (ordered[1:] + ordered[:-1]) / 2:
        accepted = similarities >= threshold
        best = max(best, (accepted[known].mean() - accepted[~known].mean(), threshold))
    return round(float(best[1]), 3)


def _share(accepted):
    return round(float(np.mean(accepted)), 4)


def _halves(rows):
    """Puts sentences alternately into one half and the other, within each kind."""
    seen, halves = {}, []
    for row in rows:
        seen[row.known, row.kind] = seen.get((row.known, row.kind), -1) + 1
        halves.append(seen[row.known, row.kind] % 2)
    return np.array(halves)


def _held_out(rows, similarities, known):
    """Computes the shares of sentences that had no part in their threshold: of each half at the other's."""
    halves, accepted, thresholds = _halves(rows), np.zeros(len(rows), bool), []
    for half in (0, 1):
        own = halves == half
        thresholds.append(best_threshold(similarities[own], known[own]))
        accepted[~own] = similarities[~own] >= thresholds[-1]
    return {"thresholds": thresholds, "accepted_known": _share(accepted[known]), "accepted_other": _share(accepted[~known])}


def summary(rows, similarities):
    """Computes threshold and shares from the similarities alone: whole, of halves that had no part in it, and by kind."""
    similarities, known = np.asarray(similarities, np.float64), np.array([row.known for row in rows])
    threshold = best_threshold(similarities, known)
    accepted = similarities >= threshold
    kinds = []
    for key in dict.fromkeys((row.known, row.kind) for row in rows):
        own = [of for row, of in zip(rows, accepted) if (row.known, row.kind) == key]
        kinds.append({"known": key[0], "kind": key[1], "sentences": len(own), "accepted": int(sum(own))})
    return {
        "acceptance": {
            "similarity": SIMILARITY,
            "threshold": threshold,
            "accepted_known": _share(accepted[known]),
            "accepted_other": _share(accepted[~known]),
        },
        "held_out": _held_out(rows, similarities, known),
        "kinds": kinds,
    }


def _left_out(setting, words, threshold):
    """Counts the known instructions that would be accepted if the table had none of their text."""
    splits = {}
    for row, own in zip(setting.instructions, words):
        others = [other for known, other in zip(setting.instructions, words) if known["text"] != row["text"]]
        splits.setdefault(row["split"], []).append(nearest(own, others)[1] >= threshold)
    return [{"split": split, "instructions": len(accepted), "accepted": int(sum(accepted))} for split, accepted in splits.items()]


def calibrate(setting, rows):
    """Calibrates a setting on a table of sentences, as plain data."""
    config = setting.config
    texts = [row["text"] for row in setting.instructions]
    encoded = language.encode(config.language, [*texts, *(row.text for row in rows)])
    words = [embedded.words for embedded in encoded.instructions]
    known, heard = words[: len(texts)], words[len(texts) :]
    found = [nearest(sentence, known) for sentence in heard]
    similarities = [round(similarity, 4) for _, similarity in found]
    result = summary(rows, similarities)
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "setting": config.name,
        "environment": setting.environment["id"],
        "language": {
            "encoder": encoded.encoder,
            "sha256": encoded.sha256,
            "dim": encoded.dim,
            "layer": config.language.layer,
            "pooling": "mean" if config.language.pool else "none",
        },
        "instructions_sha256": _texts_sha256(texts),
        **result,
        "left_out": _left_out(setting, known, result["acceptance"]["threshold"]),
        "sentences": [
            {"known": row.known, "kind": row.kind, "text": row.text, "similarity": similarity, "nearest": setting.instructions[index]["id"]}
            for row, (index, _), similarity in zip(rows, found, similarities)
        ],
    }


def _texts_sha256(texts):
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()


def write(calibrated, path):
    """Writes a calibration as JSON, one line a sentence."""
    last = {key: value for key, value in calibrated.items() if key != "sentences"}
    rows = ",\n".join("  " + json.dumps(row, ensure_ascii=False) for row in calibrated["sentences"])
    head = json.dumps(last, indent=1, ensure_ascii=False).removesuffix("\n}")
    write_atomically(path, f'{head},\n "sentences": [\n{rows}\n ]\n}}\n'.encode())


def read(path):
    """Reads a calibration that `calibrate` wrote."""
    try:
        calibrated = json.loads(Path(path).read_text(encoding="utf-8"))
        known = (calibrated["format"], calibrated["format_version"]) == (FORMAT, FORMAT_VERSION)
        calibrated["acceptance"]["threshold"], calibrated["language"]["sha256"], calibrated["instructions_sha256"]  # noqa: B018
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}: not a calibration of free sentences ({error!r}); make it with: python -m lads_exporter calibrate") from error
    if not known:
        raise UserError(f"{path}: another format than {FORMAT} {FORMAT_VERSION}; make it again with: python -m lads_exporter calibrate")
    return calibrated


def add(contract, calibrated):
    """Adds a calibration to a contract as `language.acceptance`, in a new object; refused where the calibration is of another policy's
    language."""
    made_for, own = calibrated["language"], contract["language"]
    own = {"pooling": "none", **own}
    for key in _LANGUAGE:
        if made_for[key] != own[key]:
            raise UserError(f"the calibration is for language.{key} {made_for[key]!r}, the bundle has {own[key]!r}; calibrate it anew")
    texts = [row["text"] for row in contract["instructions"]]
    if _texts_sha256(texts) != calibrated["instructions_sha256"]:
        raise UserError("the calibration is for other instructions than the bundle's; calibrate it anew")
    checked = calibrated["acceptance"]
    if checked["similarity"] != SIMILARITY or not (math.isfinite(checked["threshold"]) and -1 <= checked["threshold"] <= 1):
        raise UserError(f"the calibration's threshold is {checked}; calibrate it anew")
    return contract | {"language": contract["language"] | {"acceptance": dict(checked)}}


def into(model, calibrated):
    """Writes the calibration into the contract of a bundle, an ONNX model, and returns it."""
    for row in model.metadata_props:
        if row.key == "lads.contract":
            row.value = json.dumps(add(json.loads(row.value), calibrated))
            return model
    raise UserError("no policy bundle: the model's metadata has no lads.contract")


def beside(output):
    """Reads the calibration beside a bundle; `None` where there is none."""
    path = Path(output).with_suffix(SUFFIX)
    return read(path) if path.is_file() else None


def lines(calibrated):
    """Describes a calibration for people, in the command's output and in the model card, as Markdown."""
    chosen, held_out = calibrated["acceptance"], calibrated["held_out"]
    share = lambda value: f"{100 * value:.0f} %"
    rows = calibrated["kinds"]
    count = lambda known: sum(row["sentences"] for row in rows if row["known"] is known)
    text = [
        f"A sentence outside the table is followed from a similarity ({chosen['similarity']}) of {chosen['threshold']} to the nearest known instruction on.",
        f"Accepted at this threshold: {share(chosen['accepted_known'])} of {count(True)} sentences that ask for what the policy knows,"
        f" {share(chosen['accepted_other'])} of {count(False)} that ask for something else or nothing;"
        f" of sentences that had no part in choosing it (halves, each at the other's threshold) {share(held_out['accepted_known'])}"
        f" and {share(held_out['accepted_other'])}.",
        "The measure compares words: negations and opposites in known words are what it accepts wrongly.",
        "",
        "| sentences | known | count | accepted |",
        "|---|---|---|---|",
        *(f"| {row['kind']} | {'yes' if row['known'] else 'no'} | {row['sentences']} | {row['accepted']} |" for row in rows),
        *(f"| the table's {row['split']}, each without its own text | yes | {row['instructions']} | {row['accepted']} |" for row in calibrated["left_out"]),
    ]
    wrong = [row for row in calibrated["sentences"] if not row["known"] and row["similarity"] >= chosen["threshold"]]
    wrong.sort(key=lambda row: -row["similarity"])
    quoted = ", ".join(f"\"{row['text']}\" ({row['similarity']:.2f})" for row in wrong)
    return [*text, "", f"Accepted although not known: {quoted or 'none'}."]
