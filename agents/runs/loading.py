"""Trained policies from wherever they lie: a run, a file of parameters, the shipped ones."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from agents import pretrained
from agents.acting.policy import Policy
from agents.ppo.learner import make_train
from agents.runs import checkpoint
from agents.runs.folder import RunFolder


def load(
    source: str | Path,
    *,
    seed: int | None = None,
    iteration: int | None = None,
    greedy: bool = True,
) -> Policy:
    """A trained policy, which acts from observations alone.

        policy = load("runs/mine")
        carry = policy.initial(batch)
        action, carry = policy.act(observation, carry, key)

    Args:
      source: a run's folder, a file of parameters, or the name of shipped parameters.
      seed: which seed of a run; its first if absent.
      iteration: the checkpoint of a run to take; the newest if absent.
      greedy: take the most probable actions; false draws them.

    Raises:
      ValueError: there is no such policy, or it cannot be read.
    """
    policies = load_policies(source, iteration)
    if seed is None:
        return policies[0]._replace(greedy=greedy)
    if not _is_run(source):
        raise ValueError(f"seed names a policy of a run: {source} is none")
    _, run = RunFolder.open(Path(source))
    if seed not in run.seed_range:
        allowed = ", ".join(map(str, run.seed_range))
        raise ValueError(f"{source} has no seed {seed}; allowed: {allowed}")
    return policies[run.seed_range.index(seed)]._replace(greedy=greedy)


def load_policies(source: str | Path, iteration: int | None = None) -> list[Policy]:
    """All policies of a source: of a run one per seed, else one.

    Args:
      source: as for `load`.
      iteration: the checkpoint of a run to take; the newest if absent.

    Raises:
      ValueError: there is no such policy, or it cannot be read.
    """
    path = Path(source)
    if _is_run(source):
        return load_run(path, iteration)
    is_file = path.is_file()
    if not is_file and str(source) not in pretrained.names():
        try:
            RunFolder.open(path)
        except ValueError as error:
            shipped = ", ".join(pretrained.names()) or "none"
            raise ValueError(f"{error}; shipped parameters: {shipped}") from error
    if iteration is not None:
        raise ValueError(f"iteration names a checkpoint of a run: {source} is none")
    return [pretrained.load(path) if is_file else pretrained.load_shipped(str(source))]


def load_run(path: Path, iteration: int | None = None) -> list[Policy]:
    """The policies of a run, one per seed.

    Args:
      path: its folder.
      iteration: the checkpoint to take; the newest if absent.

    Raises:
      ValueError: there is no run or no such checkpoint, or it cannot be read.
    """
    folder, run = RunFolder.open(path)
    with checkpoint.Checkpoints(folder.checkpoints) as checkpoints:
        arrays, record = checkpoints.load(iteration)
        params = jax.tree.map(jnp.asarray, checkpoint.subtree(arrays, "params"))
        expected = jax.eval_shape(make_train(run.config).init_params, jax.random.key(0))
        try:
            seeds = [jax.tree.map(lambda x, i=i: x[i], params) for i in range(run.seeds)]
            checkpoint.from_arrays(checkpoint.to_arrays(seeds[0]), expected)
        except (ValueError, IndexError) as error:
            raise checkpoints.refuse_misfit(record, error) from error
    iterations = np.broadcast_to(arrays["iteration"], (run.seeds,))
    return [
        Policy(f"seed {seed}", run.config, policy, int(done))
        for seed, policy, done in zip(run.seed_range, seeds, iterations, strict=True)
    ]


def _is_run(source: str | Path) -> bool:
    """Whether it is a run's folder; one of another kind does not hide shipped parameters."""
    return RunFolder(Path(source)).config.is_file()
