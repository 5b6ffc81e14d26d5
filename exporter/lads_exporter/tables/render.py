"""Writes models/tables.json and models/TABLES.md: the paper's number, ours with mean and deviation over seeds, and the uncertainty within
them.

`tables.json` holds every table that was ever run, one key each; a run replaces its own only. It keeps the numbers of every finished job under
the hash of all that they depend on, so that a table can be finished on another machine. TABLES.md is written from it alone.
"""

import json
import math
import statistics
from pathlib import Path

from safetensors import safe_open

from ..config import UserError
from ..output import write_atomically

FORMAT, VERSION = "lads-tables", 1
K_RATES = 4
JSON, MARKDOWN = "tables.json", "TABLES.md"
NUMBERS = ("identity", "bundle_sha256", "training_s", "summary", "splits")  # of a job
Z = 1.959963984540054  # of 95 %


def wilson(count, total):
    """Computes the Wilson score interval of a share, 95 %, with the bits of `wilson` in sim-harness/proof/src/metrics.rs."""
    if total == 0:
        return [0.0, 1.0]
    share, z2 = count / total, Z * Z
    centre, scale = share + z2 / (2.0 * total), 1.0 + z2 / total
    half = Z * math.sqrt(share * (1.0 - share) / total + z2 / (4.0 * total * total))
    return [(centre - half) / scale if count else 0.0, (centre + half) / scale if count < total else 1.0]


def summarise(splits):
    """Sums up one split of several seeds' results: means over the seeds, intervals within them."""
    rates, full = [row["n_rate"] for row in splits], [row["full_success"] for row in splits]
    episodes, count = sum(row["episodes"] for row in splits), sum(row["full_success_count"] for row in splits)
    errors = [row["n_rate_standard_error"] for row in splits]
    deviation = lambda values: statistics.stdev(values) if len(values) > 1 else None
    return {
        "episodes": episodes,
        "success": statistics.mean(full),
        "success_deviation": deviation(full),
        "success_interval": wilson(count, episodes),
        "success_by_seed": full,
        "n_rate": statistics.mean(rates),
        "n_rate_deviation": deviation(rates),
        "n_rate_standard_error": math.sqrt(sum(error * error for error in errors)) / len(errors),
        "n_rate_by_seed": rates,
        "k_rate": [statistics.mean(row["k_rate"][k] for row in splits) for k in range(len(splits[0]["k_rate"]))],
    }


def expert(data):
    """Computes how often the scripted expert carried out all of an instruction while the data were collected; None where no expert made
    them."""
    with safe_open(data, "numpy") as file:
        notes = file.metadata() or {}
    counts = [json.loads(notes.get(key, "0")) for key in ("attempts", "discarded")]
    if not all(isinstance(count, dict) for count in counts):  # one for each instruction, where an expert followed them
        return None
    attempts, discarded = (sum(count.values()) for count in counts)
    return {"attempts": attempts, "discarded": discarded, "success": 1 - discarded / attempts, "success_interval": wilson(attempts - discarded, attempts)}


def _protocol(table):
    asked = table.evaluation
    return {"episodes_per_instruction": asked.episodes, "seed": asked.seed, "noise": asked.noise}


def recorded(models, table, jobs):
    """Finds what the file has of a table -> ({job: its numbers}, scores of uniform random actions or None, number of rows that are of no job)."""
    entry = read(Path(models) / JSON)["tables"].get(table.name, {"jobs": [], "uniform_scores": None})
    rows = {row["identity"]: row for row in entry["jobs"]}
    whole = lambda scores: set(table.splits) <= set(scores)
    found = {job: {part: rows[job.identity][part] for part in NUMBERS[1:]} for job in jobs if job.identity in rows and whole(rows[job.identity]["splits"])}
    uniform = entry["uniform_scores"]
    if uniform is not None and not (entry.get("protocol") == _protocol(table) and whole(uniform)):
        uniform = None
    return found, uniform, len(rows.keys() - {job.identity for job in jobs})


def entry(table, place, jobs, uniform):
    """Makes the entry of one table in tables.json. jobs: [(job, its numbers or None)]."""
    tracks = []
    for track in table.tracks:
        rows = []
        for system in table.rows(track):
            own = [(job.seed, found) for job, found in jobs if job.track == track and job.system == system]
            done = [(seed, found) for seed, found in own if found]
            row = {"id": system.id, "title": system.title, "published": system.published, "seeds_asked": [seed for seed, _ in own]}
            row |= {"sweep": system.sweep} if system.sweep else {}
            row |= {"seeds": [seed for seed, _ in done], "bundle_sha256": [found["bundle_sha256"] for _, found in done]}
            if done:
                row["training_s"] = statistics.mean(found["training_s"] for _, found in done)
                row["splits"] = {name: summarise([found["splits"][name] for _, found in done]) for name in table.splits}
                row["summary"] = [found["summary"] for _, found in done]
            rows.append(row)
        tracks.append({"name": track.name, "config": Path(track.config).name, "note": track.note, "rows": rows})
    found = {
        "title": table.title,
        "environment": jobs[0][0].environment,
        "measure": table.measure,
        "splits": dict(zip(table.splits, table.headings)),
        "protocol": _protocol(table),
        "dataset_sha256": place.data_sha256,
        "threads": place.threads,
        "uniform": {name: summarise([uniform[name]]) for name in table.splits} if uniform else None,
        "uniform_scores": uniform,
        "expert": expert(place.data),
        "tracks": tracks,
        "jobs": [{"track": job.track.name, "system": job.system.id, "seed": job.seed, "identity": job.identity} | found for job, found in jobs if found],
    }
    return found


def read(path):
    """Reads the file of all tables; refuses one that is something else or damaged, and says where."""
    if not path.is_file():
        return {"format": FORMAT, "format_version": VERSION, "tables": {}}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if (found["format"], found["format_version"]) != (FORMAT, VERSION):
            raise ValueError(f"{found['format']} {found['format_version']}, not {FORMAT} {VERSION}")
        for name, table in found["tables"].items():
            _check(name, table)
        markdown(found)
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, OSError) as error:
        why = f"{type(error).__name__}: {error}" if isinstance(error, LookupError) else error
        raise UserError(f"{path}: not this exporter's tables ({why}); it stays as it is: mend it, or name another folder with --models") from error
    return found


def _check(name, table):
    """Raises ValueError where the jobs of a table are not what `entry` writes."""
    identities = [row["identity"] for row in table["jobs"]]
    if len(set(identities)) < len(identities):
        raise ValueError(f"table {name}: a job stands twice")
    for row in table["jobs"]:
        where = f"table {name}: job {row['track']} {row['system']} seed {row['seed']}"
        texts = all(isinstance(row[key], str) for key in ("identity", "bundle_sha256"))
        if not (texts and is_number(row["training_s"]) and isinstance(row["summary"], dict) and row["splits"]):
            raise ValueError(f"{where}: its identity, bundle, time, summary or splits are damaged")
        check_scores(row["splits"], where)
    check_scores(table["uniform_scores"] or {}, f"table {name}: uniform random actions")


def is_number(value, most=math.inf):
    """Says whether a value is a number from 0 to `most`."""
    return type(value) in (int, float) and math.isfinite(value) and 0 <= value <= most


def check_scores(splits, where):
    """Raises ValueError where scores by split cannot be those of episodes."""
    for split, score in splits.items():
        counts = type(score["episodes"]) is int and type(score["full_success_count"]) is int and 0 <= score["full_success_count"] <= score["episodes"]
        rates = [score["full_success"], *score["k_rate"]]
        if not (counts and len(score["k_rate"]) == K_RATES and all(is_number(rate, 1) for rate in rates) and is_number(score["n_rate"], K_RATES) and is_number(score["n_rate_standard_error"])):
            raise ValueError(f"{where}: the scores of split {split} are damaged, or of fewer than two episodes")


def write(models, table, place, jobs, uniform):
    path = Path(models) / JSON
    found = read(path)
    found["tables"][table.name] = entry(table, place, jobs, uniform)
    page = markdown(found)
    write_atomically(path, (json.dumps(found, indent=1) + "\n").encode())
    write_atomically(Path(models) / MARKDOWN, page.encode())


def _published(values, measure):
    return " ± ".join(f"{value:.1f}" if measure == "success" else f"{value:.2f}" for value in values) or "-"


def _ours(split, measure):
    """Formats the mean ± deviation over seeds (interval within)."""
    if measure == "success":
        deviation = "" if split["success_deviation"] is None else f" ± {100 * split['success_deviation']:.1f}"
        low, high = split["success_interval"]
        return f"{100 * split['success']:.1f}{deviation} ({100 * low:.1f}-{100 * high:.1f})"
    deviation = "" if split["n_rate_deviation"] is None else f" ± {split['n_rate_deviation']:.2f}"
    half = Z * split["n_rate_standard_error"]
    low, high = split["success_interval"]
    return f"{split['n_rate']:.2f}{deviation} ({split['n_rate'] - half:.2f}-{split['n_rate'] + half:.2f}); all {100 * split['success']:.0f} % ({100 * low:.0f}-{100 * high:.0f})"


def _minutes(seconds):
    return f"{seconds / 60:.0f} min"


def _line(cells):
    return "| " + " | ".join(cells) + " |"


def _row(table, row):
    cells = [row["title"], ", ".join(str(seed) for seed in row["seeds"]) or "-"]
    for split in table["splits"]:
        cells.append(_published(row["published"].get(split, []), table["measure"]))
        cells.append(_ours(row["splits"][split], table["measure"]) if "splits" in row else "not finished")
    first = next(iter(row["splits"].values())) if "splits" in row else None
    cells.append(str(sum(split["episodes"] for split in row["splits"].values())) if first else "-")
    devices = sorted({found.get("device") or "cpu" for found in row.get("summary", [])} - {"cpu"})
    cells.append(f"{_minutes(row['training_s'])}{' on ' * bool(devices)}{', '.join(devices)}" if first else "-")
    cells.append(", ".join(f"`{sha256[:12]}`" for sha256 in row["bundle_sha256"]) or "-")
    return _line(cells)


def _others(table):
    """Formats the rows that no track trains."""
    width = 2 * len(table["splits"])
    lines = []
    if table["uniform"]:
        cells = [cell for split in table["splits"] for cell in ("-", _ours(table["uniform"][split], table["measure"]))]
        lines.append(_line(["uniform random actions", "-", *cells, str(sum(split["episodes"] for split in table["uniform"].values())), "-", "-"]))
    if table["expert"]:
        found = table["expert"]
        low, high = found["success_interval"]
        text = f"all {100 * found['success']:.0f} % ({100 * low:.0f}-{100 * high:.0f})"
        lines.append(_line(["scripted expert, while the data were collected", "-", "-", text, *["-"] * (width - 2), str(found["attempts"]), "-", "-"]))
    return lines


MEASURES = {
    "success": "Per cent of episodes in which the whole instruction was carried out: mean over seeds ± their standard deviation (Wilson 95 % interval over all episodes).",
    "n_rate": "N-rate, sub-tasks carried out of the four commanded: mean over seeds ± their standard deviation (95 % interval by the standard error within the seeds);"
    " all: episodes with all four (Wilson 95 %).",
}


def markdown(found):
    """Renders TABLES.md."""
    lines = ["# The paper's tables", ""]
    lines += ["Every system trained here, exported as one bundle, and run by the same runtime in `lads-run`. Written by `make table`"]
    lines += ["(`python -m lads_exporter table`) from tables.json; do not edit. The paper's numbers stand beside ours, on other data than its own."]
    for name, table in found["tables"].items():
        asked = table["protocol"]
        lines += ["", f"## {table['title']}", "", MEASURES[table["measure"]], ""]
        lines += [f"{asked['episodes_per_instruction']} episodes of each instruction, seed {asked['seed']}, noise {asked['noise']}; data `{table['dataset_sha256'][:12]}`; trained with {table['threads']} thread, or on the device named."]
        for track in table["tracks"]:
            heads = ["system", "seeds"]
            heads += [f"{heading}, {whose}" for heading in table["splits"].values() for whose in ("paper", "ours")]
            lines += ["", f"### {name}, {track['name']} track ({track['config']})", "", track["note"], ""]
            lines += [_line([*heads, "episodes", "training", "bundle"]), _line(["---"] * (len(heads) + 3))]
            lines += [_row(table, row) for row in track["rows"]]
            lines += _others(table)
    return "\n".join([*lines, ""])
