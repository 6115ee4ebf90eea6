"""Trained policies: files of parameters, runs' folders and the shipped agents."""

from pathlib import Path

import jax
import numpy as np

from agents import pretrained
from agents.acting.policy import Policy
from agents.arrays import SUFFIX, Arrays, from_arrays, read_arrays, to_arrays, write_arrays
from agents.config import Config
from agents.files import naming_file
from agents.networks.agent import PARTS, Agent, Params
from agents.runs import checkpoint
from agents.runs.folder import RunFolder, run_of, runs_near
from trap_tube_jax.checks import expand
from trap_tube_jax.imports import import_modules


def load(
    source: str | Path,
    *,
    iteration: int | None = None,
    greedy: bool = True,
    imports: tuple[str, ...] = (),
) -> Policy:
    """Loads a trained policy, which acts from observations alone.

    Loading runs no code that the source names; only modules in `imports` are imported.

    Args:
      source: a run's folder, a file of parameters, or the name of a shipped agent; `~` in a path
        is the home folder.
      iteration: checkpoint of a run; if None, the best policy of a run that selects one
        (`--evaluate-every`), else the newest checkpoint.
      greedy: take the most probable actions; False samples them.
      imports: modules to import first, which register curiosities, encoders or task sets.

    Raises:
      ValueError: there is no such policy, or it is damaged or of another version.
      OSError: a file cannot be opened.

    Example:
      >>> policy = agents.load("best-pstsy")
      >>> policy.config.env_id, policy.iteration
      ('PerceptualStructuralSymbolicTrapTube-v0', 1150)
    """
    folder = RunFolder(source)
    if folder.config.is_file():
        return _load_run(folder, iteration, imports).replace(greedy=greedy)
    path = folder.path
    if (run := run_of(path)) and path not in (run.start, run.best):
        number = f", and iteration {path.stem}" if path.parent == run.checkpoints else ""
        raise ValueError(f"{source} is in the run {run.path}; give the run{number}")
    if not path.is_file():
        path = pretrained.FILES.get(str(source), path)
    if not path.is_file():
        raise ValueError(
            f"{source} is neither a run, a file nor a shipped agent; {runs_near(path)}; "
            f"shipped agents: {', '.join(pretrained.FILES)}"
        )
    if iteration is not None:
        raise ValueError(
            f"iteration selects a checkpoint of a run, and {source} is a file; leave it out"
        )
    import_modules(imports)
    return read_policy(path).replace(greedy=greedy)


def short_name(source: str | Path) -> str:
    """Returns the name of the run, file or shipped agent, without folder and suffix."""
    path = expand(source).resolve()  # a source may be "."
    run = run_of(path)
    return (run.path if run else path).name.removesuffix(SUFFIX)


def _load_run(folder: RunFolder, iteration: int | None, imports: tuple[str, ...]) -> Policy:
    run, _ = folder.read(imports)
    if iteration is None and folder.best.is_file():
        return read_policy(folder.best)
    arrays, record = checkpoint.load(folder.checkpoints, iteration)
    prefixes = tuple(f"params/{part}/" for part in PARTS)
    stored = {name: array for name, array in arrays.items() if name.startswith(prefixes)}
    try:
        params = _params(run.config, {k.removeprefix("params/"): v for k, v in stored.items()})
    except ValueError as error:
        raise ValueError(
            f"checkpoint {record['iteration']} in {folder.checkpoints} does not fit this version: "
            f"{error}"
        ) from error
    return Policy(run.config, params, record["iteration"])


def save(path: str | Path, policy: Policy) -> None:
    """Saves a policy to one safetensors file, which `load` reads.

    Raises:
      OSError: the file cannot be written.

    Example:
      >>> agents.save("mine.safetensors", agents.load("fast-base"))
      >>> agents.load("mine.safetensors").config.env_id
      'TrapTube-v0'
    """
    params = {part: policy.params[part] for part in PARTS}
    about = {"config": policy.config.to_dict(), "iteration": policy.iteration}
    write_arrays(expand(path), to_arrays(params), about)


def read_policy(path: Path) -> Policy:
    """Reads a policy that `save` wrote.

    Raises:
      ValueError: the file is damaged, of another kind, or its settings are unknown.
      OSError: the file cannot be opened.
    """
    arrays, about = read_arrays(path)
    with naming_file(path):
        config = Config.from_dict(about["config"])
        params = _params(config, arrays)
        return Policy(config, params, about["iteration"])


def _params(config: Config, arrays: Arrays) -> Params:
    """Returns the parameters of a network; ValueError names one that does not fit or is NaN."""
    params = from_arrays(arrays, jax.eval_shape(Agent(config).init, jax.random.key(0)))
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{name} is not finite")
    return params
