"""Files of a grid's results, and what is drawn from them.

A grid's folder holds results.csv (rows of `agents.results`), curves.csv (metrics by iteration) and
grid.json (see `About`). table.md and the figures are made from only these three files.
"""

import contextlib
import dataclasses
import itertools
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import agents
import trap_tube_jax as tt
from agents.files import naming_file, read_json, write_bytes, write_json
from agents.runs.folder import GRID_FILE, RunFolder, check_name
from agents.runs.history import has_ended
from agents.runs.metrics import Table, read_rows, write_rows
from agents.runs.provenance import read_provenance
from agents.runs.results import find_runs, metrics, runs_below
from agents.runs.run import EXTENDABLE, Run, RunOptions, check_continues
from agents.sweeps import figures, tables

COUNTS = ["iteration", "episodes", "transitions", "seconds"]
CURVES = ["algorithm", "seed", *COUNTS, "success", "validation_success"]
WIDTH = 80


class About(TypedDict):
    """The content of grid.json.

    Attributes:
      title: heading of the table and the figures.
      commands: commands that have trained the runs.
      train_set: short name of the training set; "training set" for several.
      threshold: share of the validation tasks that counts as solved.
      settings: settings that all runs share.
      machines: hardware, versions and commits that trained the runs.
      unfinished: algorithm and seed of runs that have not reached their end.
      note: what else a reader must know; written by hand.
    """

    title: str
    commands: list[str]
    train_set: str
    threshold: float
    settings: dict[str, Any]
    machines: list[dict[str, Any]]
    unfinished: list[list[str | int]]
    note: NotRequired[str]


def check(root: Path, launched: Mapping[Path, Run], options: RunOptions) -> None:
    """Checks that runs can be trained, and that `collect` can average over the seeds of a point.

    Args:
      root: folder of the grid.
      launched: the runs to train by folder, also those whose folders are gone.
      options: of the runs to train.

    Raises:
      ValueError: a file is damaged, or has rows of another run whose folder is gone; a name in a
        run's settings is unknown; or a stored run differs from the one to train, or from another
        seed of its point.
    """
    _read_about(root)
    for path in launched:
        if not RunFolder(path).config.is_file():
            RunFolder(path).check_free()
    points = {run.algorithm: run for run in launched.values()}
    here = {(run.algorithm, run.seed) for run in launched.values()}
    for path in sorted(runs_below(root)):
        folder = RunFolder(path)
        stored = folder.stored()
        here.add((stored["algorithm"], stored["seed"]))
        with naming_file(folder.config):
            tt.task_set(stored["config"]["env_id"])
        if (run := launched.get(path) or points.get(stored["algorithm"])) is not None:
            run = dataclasses.replace(run, seed=stored["seed"])
            may_change = EXTENDABLE if path in launched else ()
            check_continues(path, folder.read(run.imports), (run, options), may_change)
    for path in (root / "results.csv", root / "curves.csv"):
        rows = read_rows(path)
        gone = set(zip(rows["algorithm"], rows["seed"], strict=True)) - here
        if gone:
            names = ", ".join(f"{algorithm} seed {seed}" for algorithm, seed in sorted(gone))
            raise ValueError(
                f"{path} has rows of runs whose folders are gone: {names}; restore them, or train "
                "under another --name"
            )


def collect(root: Path, command: str, launched: Mapping[Path, Run], points: Sequence[str]) -> None:
    """Writes results.csv, curves.csv and grid.json from the runs in a folder.

    Keeps the commands and the note already in grid.json.

    Args:
      root: folder of the grid.
      command: command that has trained the runs.
      launched: its runs by folder, also those that left no settings there.
      points: names of the grid's points, in the order of tables.

    Raises:
      ValueError: a file is damaged, or a folder has a name that no table can hold.
    """
    folders = find_runs(root)
    for folder in folders:
        check_name(folder.title)
    before = _read_about(root)
    commands = [*(before["commands"] if before else []), command]
    about = _about(root.name, folders, commands, _unfinished(folders, launched))
    if before and "note" in before:
        about["note"] = before["note"]
    results = _ordered(agents.results(root), points)
    write_rows(root / "results.csv", results.assign(run=results["run"].map(lambda x: Path(x).name)))
    write_rows(root / "curves.csv", _ordered(metrics(root), points)[CURVES])
    write_json(root / GRID_FILE, about)


def _ordered(rows: Table, points: Sequence[str]) -> Table:
    """Returns rows in the order of the points; other algorithms follow."""
    order = {name: index for index, name in enumerate(points)}
    return rows.sort_values(
        "algorithm", key=lambda names: names.map(order).fillna(len(order)), kind="stable"
    )


def _read_about(root: Path) -> About | None:
    """Reads grid.json; None if it is missing."""
    path = root / GRID_FILE
    return read_json(path) if path.is_file() else None


def _about(
    name: str,
    folders: Sequence[RunFolder],
    commands: Sequence[str],
    unfinished: list[list[str | int]],
) -> About:
    stored = [folder.stored() for folder in folders]
    configs = [run["config"] for run in stored]
    env_ids = dict.fromkeys(config["env_id"] for config in configs)
    train_sets = [tt.task_set(name) for name in env_ids]
    machines = itertools.chain.from_iterable(read_provenance(x.provenance) for x in folders)
    unique = {repr(machine): machine for machine in machines}
    return {
        "title": f"{name}: trained on {' or '.join(known.label for known in train_sets)}",
        "commands": list(dict.fromkeys(commands)),
        "train_set": train_sets[0].short if len(train_sets) == 1 else "training set",
        "threshold": max(config["stop_when_solved"] or 1.0 for config in configs),
        "settings": {k: v for k, v in configs[0].items() if all(c.get(k) == v for c in configs)},
        "machines": list(unique.values()),
        "unfinished": unfinished,
    }


def _unfinished(
    folders: Sequence[RunFolder], launched: Mapping[Path, Run]
) -> list[list[str | int]]:
    """Returns algorithm and seed of the runs that have not reached their end, the latest asked for.

    Of runs that another command trained, those whose modules are not imported count as finished.
    """
    runs: dict[Path, Run] = {}
    for folder in folders:
        with contextlib.suppress(ValueError):
            runs[folder.path] = folder.read()[0]
    runs |= launched
    left = [run for path, run in runs.items() if not has_ended(RunFolder(path), run)]
    return [[run.algorithm, run.seed] for run in left]


def read(root: Path) -> tuple[Table, Table, About]:
    """Reads results.csv, curves.csv and grid.json.

    Raises:
      ValueError: a file is damaged.
      OSError: a file cannot be opened.
    """
    about = read_json(root / GRID_FILE)
    return read_rows(root / "results.csv"), read_rows(root / "curves.csv"), about


def write_tables(root: Path) -> str:
    """Writes table.md from the files of `collect`.

    Returns the tables as text of at most 80 columns.
    """
    results, curves, about = read(root)
    found = tables.tables(results, curves, about)
    note = tables.unfinished_note(about)
    parts = [f"**{heading}**\n\n{tables.markdown(table)}" for heading, table in found.items()]
    parts += [*note, tables.NOTE]
    parts += [tables.escape(about["note"])] if "note" in about else []
    parts += [f"    {command}" for command in about["commands"]]  # indented, a block of code
    parts += [
        tables.escape(
            f"{machine['cores']} core(s) of {machine['processor']}, {machine['device']}; "
            f"jax {machine['jax']}, commit {machine['commit']}."
        )
        for machine in about["machines"]
    ]
    text = "\n\n".join([f"# {tables.escape(about['title'])}", *parts]) + "\n"
    write_bytes(root / "table.md", text.encode())
    shown = [f"{name}\n{found[name].to_string(line_width=WIDTH)}" for name in found]
    return "\n\n".join([*shown, *(textwrap.fill(line, WIDTH) for line in note)])


def draw(root: Path) -> list[Path]:
    """Draws the figures from the files of `collect`, and returns their files."""
    return figures.save(root, *read(root))
