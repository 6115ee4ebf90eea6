"""Trained policies from wherever they lie: a run, a file of parameters, the shipped ones."""

from pathlib import Path
from typing import Any

import jax

from agents import pretrained
from agents.acting import policy_files
from agents.acting.policy import Policy
from agents.arrays import from_arrays
from agents.networks.agent import PARTS, Agent
from agents.runs.checkpoint import Checkpoints
from agents.runs.folder import Run, RunFolder

SEED = "seed "  # before its number, the name of a run's policy


def load_policy(
    source: str | Path, seed: int | None = None, iteration: int | None = None
) -> Policy:
    """One greedy policy of a source; see `agents.load`."""
    found = {policy.name: policy for policy in load_policies(source, iteration)}
    name = next(iter(found)) if seed is None else f"{SEED}{seed}"
    if name not in found:
        seeds = [each.removeprefix(SEED) for each in found if each.startswith(SEED)]
        raise ValueError(f"{source} has no seed {seed}; allowed: {', '.join(seeds) or 'none'}")
    return found[name]


def load_policies(source: str | Path, iteration: int | None = None) -> list[Policy]:
    """All policies of a source: of a run one per seed, else one.

    Args:
      source: a run's folder, a file of parameters, or the name of shipped parameters.
      iteration: the checkpoint of a run to take; the newest if absent.

    Raises:
      ValueError: there is no such policy, or it cannot be read.
    """
    path = Path(source)
    if RunFolder(path).config.is_file():  # another folder does not hide shipped parameters
        return load_run(path, iteration)
    is_file = path.is_file()
    if not is_file and str(source) not in pretrained.names():
        try:
            RunFolder.open(path)
        except ValueError as error:
            shipped = ", ".join(pretrained.names()) or "none"
            raise ValueError(f"{error}; shipped parameters: {shipped}") from error
    if iteration is not None:
        raise ValueError(f"iteration names a checkpoint of a run: {source} is not a run")
    return [policy_files.load_policy(path) if is_file else pretrained.load_shipped(str(source))]


def load_run(path: Path, iteration: int | None = None) -> list[Policy]:
    """The policies of a run, one per seed.

    Args:
      path: its folder.
      iteration: the checkpoint to take; the newest if absent.

    Raises:
      ValueError: there is no run or no such checkpoint, or it cannot be read.
    """
    folder, run = RunFolder.open(path)
    keys = jax.random.split(jax.random.key(0), run.seeds)
    expected = {"params": jax.eval_shape(jax.vmap(Agent(run.config).init), keys)}
    with Checkpoints(folder.checkpoints) as checkpoints:
        arrays, record = checkpoints.load(iteration)
        wanted = tuple(f"params/{part}/" for part in PARTS)
        stored = {name: array for name, array in arrays.items() if name.startswith(wanted)}
        try:
            params = from_arrays(stored, expected)["params"]
        except ValueError as error:
            raise checkpoints.refuse_misfit(record, error) from error
    return policies(run, params, arrays["iteration"])


def policies(run: Run, params: Any, iterations: Any) -> list[Policy]:
    """The policies of a run, one per seed.

    Args:
      run: the run.
      params: the parameters [S, ...] of all seeds; those of a curiosity are left out.
      iterations: i32[S], the iterations that they are after.
    """
    params = {part: params[part] for part in PARTS}
    return [
        Policy(
            f"{SEED}{seed}",
            run.config,
            jax.tree.map(lambda x, index=index: x[index], params),
            int(iterations[index]),
        )
        for index, seed in enumerate(run.seed_range)
    ]
