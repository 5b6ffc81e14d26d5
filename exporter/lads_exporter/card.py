"""Writes the model card: what the bundle was made from and by, and what it reached."""

import csv
import json
from collections import Counter
from pathlib import Path

from . import acceptance, contract as contracts
from .config import LADS, UserError
from .training import CURVES, SUMMARY


SYSTEMS = {
    "lads": "LADS",
    "vae": "VAE (or LADS with a VAE)",
    "cluster": "Cluster",
    "lang_dt": "Lang DT",
    "lisa": "LISA",
    "lcsd": "LCSD (our reading)",
    "skilldiffuser": "SkillDiffuser",
}


def read_results(path):
    """Reads a results file of lads-run."""
    try:
        results = json.loads(Path(path).read_text(encoding="utf-8"))
        for split in results["splits"].values():
            for key in ("episodes", "n_rate", "k_rate", "full_success", "full_success_interval", "un_instructed"):
                split[key]
        return results
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
        raise UserError(f"{path}: not a results file of lads-run --json ({error!r})") from error


def _number(value):
    return "-" if value is None else f"{value:.2f}"


def _row(label, split):
    """Formats one line of a results table; rates without episodes are null in the file and a dash here."""
    k = " ".join(_number(value) for value in split["k_rate"])
    low, high = split["full_success_interval"]
    full = f"{_number(split['full_success'])} ({_number(low)}-{_number(high)})"
    return f"| {label} | {split['episodes']} | {_number(split['n_rate'])} | {k} | {full} | {split['un_instructed']} |"


def _table(rows):
    head = "| | episodes | N-rate | K-rate 1 2 3 4 | full success (Wilson 95 %) | un-instructed sub-tasks |"
    return [head, "|---|---|---|---|---|---|", *rows]


def _counts(rates):
    return ", ".join(f"{rate['sub_task']} {rate['count']}" for rate in rates)


def _results(results, sha256, beside):
    lines = ["", "## Results", ""]
    if results is None:
        return [*lines, "Not measured yet: run `lads-run --json FILE` and write this card again with `--results FILE`."]
    if results.get("bundle_sha256") != sha256:
        raise UserError(f"the results are of another bundle ({results.get('bundle_sha256')}), not of {sha256}")
    lines += [f"`lads-run`, seed {results.get('seed')}, noise {results.get('noise')}, versions {json.dumps(results.get('versions'))}.", ""]
    lines += _table([_row(name, split) for name, split in results["splits"].items()])
    lines += ["", "| instruction | split | episodes | N-rate | completed, of the commanded | un-instructed |", "|---|---|---|---|---|---|"]
    for row in results.get("instructions", []):
        done, others = (_counts(row.get(key, [])) for key in ("completions", "un_instructed_completions"))
        lines.append(f"| {row['id']} | {row['split']} | {row['episodes']} | {_number(row.get('n_rate'))} | {done} | {others} |")
    if beside:
        lines += ["", "## Other settings and seeds", ""]
        pairs = [(label, name, split) for label, other in beside for name, split in other["splits"].items()]
        lines += _table([_row(f"{label}, {name}", split) for label, name, split in pairs])
    return lines


def _curves(folder):
    """Formats the first and last row of each stage's curves."""
    with open(Path(folder) / CURVES, encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    columns = ("loss", "bc", "align", "ce", "perplexity", "val_bc", "val_ce", "val_accuracy")
    lines = ["| stage | step | " + " | ".join(columns) + " |", "|---" * (len(columns) + 2) + "|"]
    for stage in dict.fromkeys(row["stage"] for row in rows):
        own = [row for row in rows if row["stage"] == stage]
        for row in (own[0], own[-1]):
            lines.append(f"| {stage} | {row['step']} | " + " | ".join(row[name] for name in columns) + " |")
    return lines


def free_sentences(calibrated):
    """Writes the card's section on sentences outside the table."""
    if calibrated is None:
        return ["", "## Free sentences", "", "Not calibrated: sentences outside the table are refused unless the caller insists."]
    return ["", "## Free sentences", "", *acceptance.lines(calibrated)]


def _plans(summary):
    """Describes how the plans are used, where there are any."""
    if "codebook_size" in summary:
        share = summary["perplexity"] / summary["codebook_size"]
        return [f"- codebook: perplexity {summary['perplexity']:.1f} of {summary['codebook_size']} over the dataset ({share:.0%}), {summary['revived']} codes revived"]
    if "plan_elements" in summary:
        return [f"- plans: {summary['plan_elements_in_use']} of {summary['plan_elements']} elements carry something, {summary['divergence']:.1f} nats in all"]
    return []


def storage(metadata):
    """Returns the card's line on how a bundle's numbers are stored, and on what evidence; `metadata` is the bundle's, by key."""
    text = metadata.get(contracts.STORAGE_KEY)
    if text is None:
        return "- numbers: 32-bit floats; `lads-run tune` looks for smaller ones that decide the same"
    record = json.loads(text)
    stored, seen = record["storage"], record["evidence"]
    entries = {}
    for part, kind in stored["parts"].items():
        entry = "/".join(part.split("/")[:2])  # an entry's name, or what a node's begins with
        entries.setdefault(entry, []).append((part, kind))
    said = []
    for entry, rows in entries.items():
        kinds = [kind for part, kind in rows if part == entry] or [stored["weights"]]
        nodes = Counter(kind for part, kind in rows if part != entry)
        said.append(", ".join([f"{entry} {kinds[0]}", *(f"but {kind} in {count} of its layers" for kind, count in nodes.items())]))
    parts = f" ({'; '.join(said)})" if said else ""
    clear = f"{seen['clear_share']:.1%} of them clear by {seen['margin_factor']:g} times the {seen['largest_logit_error']:.1e} that a logit moves"
    margin = f" ({clear}; smallest margin {seen['smallest_margin']:.1e})" if seen.get("smallest_margin") is not None else ""
    return (
        f"- numbers: {stored['weights']} weights{parts}, {stored['cache']} cache, by `lads-run tune`: the same indices in "
        f"{seen['decisions']} decisions{margin}, actions moved by {seen['largest_action_error']:.1e} in {seen['steps']} steps"
    )


def write(folder, saved, sha256, metadata, results=None, beside=(), notes="", calibrated=None):
    """Writes the card as Markdown. `folder` is the run's, `saved` its checkpoint, `metadata` the bundle's, `notes` what a person has to say, `calibrated`
    which sentences it follows."""
    summary = json.loads((Path(folder) / SUMMARY).read_text(encoding="utf-8"))
    tables, environment, _ = saved["identity"]["tables"]
    steps = ", ".join(f"{name} {count} ({summary['seconds'][name]:.0f} s)" for name, count in summary["steps"].items())
    held_out = ", ".join(f"{name.removeprefix('val_')} {value:.4g}" for name, value in summary["validation"].items())
    lines = [
        f"# Model card: {tables['name']}",
        "",
        f"A {SYSTEMS[tables.get('system', LADS)['kind']]} policy for {environment['id']} (version {environment['version']}), one ONNX file with the contract and a golden episode inside.",
        "Intended for simulation and study; it has seen no real robot.",
        "",
        f"- sha256 of the bundle: `{sha256}`",
        storage(metadata),
        f"- data: {summary['episodes']} episodes, {summary['transitions']} transitions, sha256 `{summary['dataset_sha256']}`",
        *(f"- data, {name}: {value if isinstance(value, str) else json.dumps(value)}" for name, value in saved["notes"].items()),
        f"- language encoder: {tables['language']['encoder']}, layer {tables['language']['layer']}, sha256 `{saved['identity']['language_sha256']}`",
        f"- training: {summary['schedule']}, seed {summary['seed']}, steps {steps}",
        *_plans(summary),
        f"- held out: {held_out}",
        f"- versions: {', '.join(f'{name} {version}' for name, version in summary['versions'].items())}",
        *_results(results, sha256, beside),
        *free_sentences(calibrated),
        *(["", notes.strip()] if notes else []),
        "",
        "## Curves",
        "",
        *_curves(folder),
        "",
        "## Configuration",
        "",
        "```json",
        json.dumps(tables, indent=1),
        "```",
        "",
    ]
    return "\n".join(lines)
