"""Files of a grid's results, and what is drawn from them.

A grid's folder holds results.csv (rows of `agents.results`), curves.csv (metrics by iteration) and
grid.json (title, commands, settings that all runs share, machines, unfinished runs). table.md and
the figures are made from only these three files.
"""

import itertools
import textwrap
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd

import agents
from agents.files import read_json, write_bytes, write_json
from agents.runs.folder import RunFolder
from agents.runs.metrics import Table
from agents.runs.progress import has_ended
from agents.runs.results import find_runs, metrics
from agents.sweeps import figures, tables
from trap_tube_jax.registry import task_set

COUNTS = ["iteration", "episodes", "transitions", "seconds"]
CURVES = ["algorithm", "seed", *COUNTS, "success", "validation_success"]
WIDTH = 80
ABOUT = "grid.json"


def collect(root: Path, command: str) -> None:
    """Writes results.csv, curves.csv and grid.json from the runs in a folder.

    `command` is added to those that have trained the runs before.
    """
    results = agents.results(root)
    results["run"] = results["run"].map(lambda path: Path(path).name)
    results.to_csv(root / "results.csv", index=False)
    metrics(root)[CURVES].to_csv(root / "curves.csv", index=False)
    folders = find_runs(root)
    stored = [read_json(folder.config) for folder in folders]
    configs = [run["config"] for run in stored]
    machines = [read_json(folder.provenance) for folder in folders if folder.provenance.exists()]
    commands = commands_of(read_json(root / ABOUT)) if (root / ABOUT).exists() else []
    first = configs[0]
    train_sets = [task_set(name) for name in dict.fromkeys(config["env_id"] for config in configs)]
    about = {
        "title": f"{root.name}: trained on {' or '.join(known.label for known in train_sets)}",
        "commands": list(dict.fromkeys([*commands, command])),
        "train_set": train_sets[0].short if len(train_sets) == 1 else "training set",
        "threshold": max(config["stop_when_solved"] or 1.0 for config in configs),
        "settings": {k: v for k, v in first.items() if all(c.get(k) == v for c in configs)},
        "machines": distinct(itertools.chain(*machines)),
        "unfinished": [
            [run["algorithm"], run["seed"]]
            for folder, run in zip(folders, stored, strict=True)
            if is_unfinished(folder)
        ],
    }
    write_json(root / ABOUT, about)


def write(root: Path) -> str:
    """Writes table.md and the figures from the files of `collect`.

    Returns:
      The main tables as text of at most 80 columns, and the files that were written.
    """
    results, curves = (read_table(root / name) for name in ("results.csv", "curves.csv"))
    about = read_json(root / ABOUT)
    found = tables.tables(results, curves, about)
    note = tables.unfinished_note(about)
    parts = [f"**{heading}**\n\n{tables.markdown(table)}" for heading, table in found.items()]
    parts += [*note, tables.NOTE, *(f"`{command}`" for command in commands_of(about))]
    parts += [
        f"{machine['cores']} core(s) of {machine['processor']}, {machine['device']}; "
        f"jax {machine['jax']}, commit `{machine['commit']}`."
        for machine in about["machines"]
    ]
    text = "\n\n".join([f"# {about['title']}", *parts]) + "\n"
    write_bytes(root / "table.md", text.encode())
    drawn = figures.save(root, results, curves, about)
    shown = [f"{name}\n{found[name].to_string(line_width=WIDTH)}" for name in found]
    shown += [textwrap.fill(line, WIDTH) for line in note]
    files = map(str, (root / "results.csv", root / "table.md", *drawn))
    return "\n\n".join([*shown, "\n".join(files)])


def read_table(path: Path) -> Table:
    """Reads a CSV file in which only an empty field is missing: a task set may be named NA."""
    return pd.read_csv(path, keep_default_na=False, na_values=[""])


def commands_of(about: Mapping[str, Any]) -> list[str]:
    """Returns the commands that have trained the runs; records of before had one."""
    return about.get("commands") or [about["command"]]


def is_unfinished(folder: RunFolder) -> bool:
    """Returns whether a run has not reached its end, as far as that is known here."""
    try:
        run, _ = folder.read()
    except ValueError:  # its modules are not imported, so its command was another one
        return False
    return not has_ended(folder, run)


def distinct(values: Iterable[Any]) -> list[Any]:
    """Returns plain values once each, in order; unlike `dict.fromkeys`, also unhashable ones."""
    found: list[Any] = []
    for value in values:
        if value not in found:
            found.append(value)
    return found
