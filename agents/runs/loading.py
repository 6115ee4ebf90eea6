"""Trained policies: files of parameters, runs' folders and the shipped agents."""

from pathlib import Path

import jax

from agents import pretrained
from agents.acting.policy import Policy
from agents.arrays import SUFFIX, Arrays, from_arrays, read_arrays, to_arrays, write_arrays
from agents.config import Config
from agents.networks.agent import PARTS, Agent, Params
from agents.runs import checkpoint
from agents.runs.folder import RunFolder, runs_next_to
from trap_tube_jax.imports import import_modules


def load(
    source: str | Path,
    *,
    iteration: int | None = None,
    greedy: bool = True,
    imports: tuple[str, ...] = (),
) -> Policy:
    """Loads a trained policy, which acts from observations alone.

        policy = load("best-pstsy")
        carry = policy.initial(batch)
        action, carry = policy.act(observation, carry, key)

    Loading runs no code that the source names; only modules in `imports` are imported.

    Args:
      source: a run's folder, a file of parameters, or the name of a shipped agent.
      iteration: checkpoint of a run; if None, the best policy of a run that selects one
        (`--evaluate-every`), else the newest checkpoint.
      greedy: take the most probable actions; False samples them.
      imports: modules to import first, which register curiosities, encoders or task sets.

    Raises:
      ValueError: there is no such policy, or it is damaged or of another version.
      OSError: a file cannot be opened.
    """
    folder, path = RunFolder(Path(source)), Path(source)
    if not folder.config.is_file():
        if not path.is_file() and str(source) in pretrained.names():
            path = pretrained.FOLDER / f"{source}{SUFFIX}"
        if not path.is_file():
            raise ValueError(
                f"{source} is neither a run, a file nor a shipped agent; {runs_next_to(path)}; "
                f"shipped agents: {', '.join(pretrained.names())}"
            )
        if iteration is not None:
            raise ValueError(f"iteration is for runs, which {source} is not; leave it out")
        import_modules(imports)
        return read_policy(path).replace(greedy=greedy)
    run, options = folder.read(imports)
    name = f"seed {run.seed}"
    if iteration is None and options.evaluate_every and folder.best.is_file():
        return read_policy(folder.best).replace(name=name, greedy=greedy)
    arrays, record = checkpoint.load(folder.checkpoints, iteration)
    prefixes = tuple(f"params/{part}/" for part in PARTS)
    stored = {name: array for name, array in arrays.items() if name.startswith(prefixes)}
    try:
        params = _params(run.config, {k.removeprefix("params/"): v for k, v in stored.items()})
    except ValueError as error:
        raise ValueError(f"{folder.checkpoints} does not fit this version: {error}") from error
    return Policy(name, run.config, params, record["iteration"], greedy)


def save(path: str | Path, policy: Policy) -> None:
    """Saves a policy to one safetensors file, which `load` reads; its name is not stored."""
    params = {part: policy.params[part] for part in PARTS}
    about = {"config": policy.config.to_dict(), "iteration": policy.iteration}
    write_arrays(Path(path), to_arrays(params), about)


def read_policy(path: Path) -> Policy:
    """Reads a policy that `save` wrote; the file's name without its suffix names it.

    Raises:
      ValueError: the file is damaged, of another kind, or its settings are unknown.
      OSError: the file cannot be opened.
    """
    arrays, about = read_arrays(path)
    try:
        config, iteration = Config.from_dict(about["config"]), int(about["iteration"])
        params = _params(config, arrays)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} does not hold a policy of this version: {error}") from error
    return Policy(path.name.removesuffix(SUFFIX), config, params, iteration)


def _params(config: Config, arrays: Arrays) -> Params:
    return from_arrays(arrays, jax.eval_shape(Agent(config).init, jax.random.key(0)))
