"""Policies as single files: parameters, with the settings in the header."""

from pathlib import Path

import jax
import numpy as np

from agents.acting.policy import Policy
from agents.arrays import SUFFIX, from_arrays, read_arrays, to_arrays, write_arrays
from agents.config import Config
from agents.networks.agent import PARTS, Agent


def save_policy(path: Path, policy: Policy) -> None:
    """Writes the parameters and settings of a policy, atomically; its name is not stored."""
    params = {part: policy.params[part] for part in PARTS}
    about = {"config": policy.config.to_dict(), "iteration": policy.iteration}
    write_arrays(path, to_arrays(params), about)


def load_policy(path: Path) -> Policy:
    """Reads a policy that `save_policy` wrote; the file's name without its suffix names it.

    Raises:
      ValueError: the file is damaged, of another kind, or its settings are unknown.
      OSError: the file cannot be opened.
    """
    arrays, about = read_arrays(path)
    try:
        config, iteration = Config.from_dict(about["config"]), int(about["iteration"])
        template = jax.eval_shape(Agent(config).init, jax.random.key(0))
        params = from_arrays(arrays, template)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} does not hold a policy of this version: {error}") from error
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{path} holds parameters that are not finite: {name}")
    return Policy(path.name.removesuffix(SUFFIX), config, params, iteration)
