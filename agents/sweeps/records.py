"""Files of a grid's results, and what is drawn from them.

A grid's folder holds results.csv (rows of `agents.results`), curves.csv (metrics by iteration) and
grid.json (title, command, settings that all runs share, machines). table.md and the figures are
made from only these three files.
"""

import itertools
from pathlib import Path

import pandas as pd

import agents
from agents.files import read_json, write_bytes, write_json
from agents.runs.results import find_runs, metrics
from agents.sweeps import figures, tables
from trap_tube_jax.registry import task_set

COUNTS = ["iteration", "episodes", "transitions", "seconds"]
CURVES = ["algorithm", "seed", *COUNTS, "success", "validation_success"]
WIDTH = 80


def collect(root: Path, command: str) -> None:
    """Writes results.csv, curves.csv and grid.json from the runs in a folder."""
    results, curves, folders = agents.results(root), metrics(root), find_runs(root)
    results["run"] = results["run"].map(lambda path: Path(path).name)
    results.to_csv(root / "results.csv", index=False)
    curves[CURVES].to_csv(root / "curves.csv", index=False)
    configs = [read_json(folder.config)["config"] for folder in folders]
    noted = [read_json(folder.provenance) for folder in folders if folder.provenance.exists()]
    machines, first = list(itertools.chain(*noted)), configs[0]
    train_sets = [task_set(name) for name in dict.fromkeys(own["env_id"] for own in configs)]
    about = {
        "title": f"{root.name}: trained on {' or '.join(each.label for each in train_sets)}",
        "command": command,
        "train_set": train_sets[0].short if len(train_sets) == 1 else "training set",
        "threshold": max(own["stop_when_solved"] or 1.0 for own in configs),
        "settings": {k: v for k, v in first.items() if all(own.get(k) == v for own in configs)},
        "machines": [each for place, each in enumerate(machines) if each not in machines[:place]],
    }
    write_json(root / "grid.json", about)


def write(root: Path) -> str:
    """Writes table.md and the figures from the files of `collect`.

    Returns:
      The main tables as text of at most 80 columns, and the files that were written.
    """
    results, curves = (pd.read_csv(root / name) for name in ("results.csv", "curves.csv"))
    about = read_json(root / "grid.json")
    found = tables.tables(results, curves, about)
    parts = [f"**{heading}**\n\n{tables.markdown(table)}" for heading, table in found.items()]
    parts += [tables.NOTE, f"`{about['command']}`"]
    parts += [
        f"{machine['cores']} core(s) of {machine['processor']}, {machine['device']}; "
        f"jax {machine['jax']}, commit `{machine['commit']}`."
        for machine in about["machines"]
    ]
    text = "\n\n".join([f"# {about['title']}", *parts]) + "\n"
    write_bytes(root / "table.md", text.encode())
    drawn = figures.save(root, results, curves, about)
    shown = [f"{name}\n{found[name].to_string(line_width=WIDTH)}" for name in found]
    files = map(str, (root / "results.csv", root / "table.md", *drawn))
    return "\n\n".join([*shown, "\n".join(files)])
