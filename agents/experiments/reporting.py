"""What the runs of an experiment came to: the record, and its tables and figures."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

import trap_tube_jax as tt
from agents.acting.evaluation import Evaluator
from agents.acting.policy_files import load_policy
from agents.experiments import figures, records, tables
from agents.experiments.protocol import Protocol, algorithms
from agents.experiments.records import Record, Steps
from agents.experiments.training import AlgorithmRun, draw_tasks, find_runs
from agents.runs.folder import read_json, write_json
from trap_tube_jax.scoring.tasks import layout_numbers
from trap_tube_jax.solver.search import solve_batch, take
from trap_tube_jax.state import State

NUM_COMPARED = 128  # tasks per set whose shortest plans are searched for, in a second or two


def make_record(root: Path, experiment: str, protocol: Protocol, console: Console) -> Record:
    """The record of all runs in an experiment's folder.

    Args:
      root: the folder.
      experiment: which of `PROTOCOLS`.
      protocol: how it is run.
      console: where to show what is being done.

    Raises:
      ValueError: there is no run yet, or one cannot be read.
    """
    runs = [entry for entry in find_runs(root) if entry.rows]
    if not runs:
        raise ValueError(f"{root} holds no run with a first iteration yet")
    tasks = draw_tasks(runs[0].run.config, protocol.sets, protocol.num_reported, "test")
    order = {name: place for place, name in enumerate(algorithms())}
    names = dict.fromkeys(entry.algorithm for entry in runs)
    names = sorted(names, key=lambda name: order.get(name.partition(",")[0], len(order)))
    machines: list[Any] = []
    reached = []
    with console.status("Playing the reported tasks ..."):
        for name in names:
            entries = [entry for entry in runs if entry.algorithm == name]
            reached.append(_algorithm(name, entries, protocol, tasks, machines))
    whole = _whole_protocol(protocol, runs)
    return {
        "schema": records.SCHEMA,
        "experiment": experiment,
        "command": whole.command(experiment, names, _devices(machines)),
        "protocol": dataclasses.asdict(whole),
        "ranked": list(protocol.ranked),
        "machines": machines,
        "sets": {
            name: {
                "max_steps": runs[0].run.config.step_limit(name),
                **_about(name, states),
            }
            for name, states in tasks.items()
        },
        "algorithms": reached,
    }


def report(root: Path, record: Record, console: Console) -> None:
    """Writes the record, its tables and its figure into the folder, and shows the tables."""
    files = {
        "summary": root / "summary.json",
        "tables": root / "tables.md",
        "figure": root / "curves.png",
    }
    write_json(files["summary"], record)
    text = f"# {tables.title(record)}\n\n{tables.markdown(record)}\n"
    files["tables"].write_text(text, encoding="utf-8")
    figures.save(record, files["figure"])
    for table in tables.tables(record):
        console.print(table.to_rich())
    for line in tables.notes(record):
        console.print(line, soft_wrap=True, highlight=False)
    for name, path in files.items():
        console.print(f"{name:>10}: {path}", soft_wrap=True, highlight=False)


def equal_to_base(tasks: State) -> float:
    """The percentage of tasks that equal the base task."""
    base = tt.base_state(tasks.palette.shape[-1])
    same = jax.tree.map(
        lambda x, y: np.all(np.asarray(x) == np.asarray(y), axis=tuple(range(1, x.ndim))),
        tasks,
        base,
    )
    return 100 * float(np.mean(np.all(jax.tree.leaves(same), axis=0)))


def best_steps(
    entry: AlgorithmRun, seed: int, protocol: Protocol, evaluator: Evaluator
) -> Steps | None:
    """The steps that a seed's best policy takes in the reported tasks, 0 where unsolved.

    What was played is kept in the run's folder.

    Args:
      entry: the seed's run.
      seed: which one.
      protocol: how the experiment is run.
      evaluator: plays the reported tasks.

    Returns:
      By set i32[B]; None if the seed has not been evaluated yet.

    Raises:
      ValueError: its parameters cannot be read.
    """
    best = records.best_row(records.of_seed(entry.rows, seed))
    if best is None:
        return None
    iteration = int(best["iteration"])
    path, key = entry.folder.tested(seed), [iteration, protocol.num_reported]
    known = read_json(path)
    if known is None or known["iteration_and_tasks"] != key:
        policy = load_policy(entry.folder.best(seed, iteration))
        played = evaluator(policy.params).items()
        steps = {name: (each.length * each.solved).tolist() for name, each in played}
        known = {"iteration_and_tasks": key, "steps": steps}
        write_json(path, known)
    return known["steps"]


def _algorithm(
    name: str,
    entries: Sequence[AlgorithmRun],
    protocol: Protocol,
    tasks: Mapping[str, State],
    machines: list[Any],
) -> dict[str, Any]:
    config = entries[0].run.config
    evaluator = Evaluator(config, tasks)
    seeds = [
        records.seed_record(
            entry,
            seed,
            machines=machines,
            evaluate_every=protocol.evaluate_every,
            steps=best_steps(entry, seed, protocol, evaluator),
        )
        for entry in entries
        for seed in entry.run.seed_range
        if records.of_seed(entry.rows, seed)
    ]
    return {"name": name, "config": config.to_dict(), "runs": seeds}


def _about(name: str, tasks: State) -> dict[str, Any]:
    layout = layout_numbers(name, tasks)
    return {
        "equal_to_base": equal_to_base(tasks),
        "layout": None if layout is None else layout.tolist(),
        "shortest": solve_batch(take(tasks, slice(NUM_COMPARED))).length.tolist(),
    }


def _devices(machines: Sequence[Record]) -> int | None:
    """How many devices every run was trained on; None where they differ or are unknown."""
    numbers = {machine.get("devices") for machine in machines}
    return numbers.pop() if len(numbers) == 1 else None


def _whole_protocol(protocol: Protocol, runs: Sequence[AlgorithmRun]) -> Protocol:
    """The protocol that comes to all these runs at once."""
    seeds = [seed for entry in runs for seed in entry.run.seed_range]
    return dataclasses.replace(
        protocol,
        algorithms=tuple(dict.fromkeys(entry.algorithm for entry in runs)),
        iterations=max(entry.run.config.iterations for entry in runs),
        seed=min(seeds),
        seeds=max(seeds) - min(seeds) + 1,
    )
