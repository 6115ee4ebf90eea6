"""Trained policies from a run, a file or the shipped agents."""

from pathlib import Path
from typing import Any

import jax
import numpy as np

from agents import pretrained
from agents.acting import policy_files
from agents.acting.policy import Policy
from agents.arrays import SUFFIX, from_arrays
from agents.networks.agent import PARTS, Agent
from agents.runs import checkpoint
from agents.runs.folder import CONFIG_FILE, Run, RunFolder, runs_next_to
from trap_tube_jax.imports import import_modules
from trap_tube_jax.state import take


def load_policies(
    source: str | Path, iteration: int | None = None, imports: tuple[str, ...] = ()
) -> list[Policy]:
    """Loads all greedy policies of a source: one per seed of a run, else one.

    Args:
      source: a run's folder, a file of parameters, or the name of a shipped agent.
      iteration: checkpoint of a run; the newest if None.
      imports: modules to import first, which register names of the settings. No other module is
        imported, whatever the source says.

    Raises:
      ValueError: there is no such policy, or it cannot be read.
    """
    path = Path(source)
    is_run = (path / CONFIG_FILE).is_file()
    if not is_run and not path.is_file() and str(source) in pretrained.names():
        path = pretrained.FOLDER / f"{source}{SUFFIX}"
    if path.is_file():
        import_modules(imports)
        if iteration is not None:
            raise ValueError(f"iteration is for runs, which {source} is not; leave it out")
        return [policy_files.load_policy(path)]
    if not is_run:
        raise ValueError(
            f"{source} is neither a run, a file nor a shipped agent; {runs_next_to(path)}; "
            f"shipped agents: {', '.join(pretrained.names())}"
        )
    folder = RunFolder(path)
    run = folder.read(imports)
    arrays, _ = checkpoint.load(folder.checkpoints, iteration)
    keys = jax.random.split(jax.random.key(0), run.seeds)
    expected = {"params": jax.eval_shape(jax.vmap(Agent(run.config).init), keys)}
    wanted = tuple(f"params/{part}/" for part in PARTS)
    stored = {name: array for name, array in arrays.items() if name.startswith(wanted)}
    try:
        params = from_arrays(stored, expected)["params"]
    except ValueError as error:
        raise ValueError(f"{folder.checkpoints} does not fit this version: {error}") from error
    return list(policies(run, params, arrays["iteration"]).values())


def policies(run: Run, params: Any, iterations: np.ndarray) -> dict[int, Policy]:
    """Returns policies by seed, given parameters [S, ...] that were trained i32[S] iterations."""
    params = {part: params[part] for part in PARTS}
    return {
        seed: Policy(f"seed {seed}", run.config, take(params, index), int(iterations[index]))
        for index, seed in enumerate(run.seed_range)
    }
