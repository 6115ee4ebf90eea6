"""Policies as single files: parameters in the safetensors format, settings as JSON in its header.

Reading a file runs no code from it and allocates no more than its size.
"""

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import safetensors
import safetensors.numpy

from agents.acting.policy import Policy
from agents.arrays import Arrays, from_arrays, to_arrays
from agents.config import Config
from agents.files import write_bytes
from agents.networks.agent import PARTS, Agent

SUFFIX = ".safetensors"


def save_policy(path: Path, policy: Policy) -> None:
    """Writes the parameters and settings of a policy, atomically; its name is not stored."""
    # One entry, because safetensors writes several in any order.
    header = {
        "policy": json.dumps({"config": policy.config.to_dict(), "iteration": policy.iteration})
    }
    params = {part: policy.params[part] for part in PARTS}
    write_bytes(path, safetensors.numpy.save(to_arrays(params), header))


def load_policy(path: Path) -> Policy:
    """Reads a policy that `save_policy` wrote; the file's name without its suffix names it.

    Raises:
      ValueError: the file is damaged, of another kind, or its settings are unknown.
      OSError: the file cannot be opened.
    """
    header, arrays = _read(path)
    try:
        values = json.loads(header["policy"])
        config, iteration = Config.from_dict(values["config"]), int(values["iteration"])
        template = jax.eval_shape(Agent(config).init, jax.random.key(0))
        params = from_arrays(arrays, template)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} does not hold a policy of this version: {error}") from error
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{path} holds parameters that are not finite: {name}")
    return Policy(path.name.removesuffix(SUFFIX), config, params, iteration)


def _read(path: Path) -> tuple[dict[str, Any], Arrays]:
    with path.open("rb"):  # an OSError names the file, safetensors' own may not
        pass
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            header = file.metadata() or {}
            return header, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except safetensors.SafetensorError as error:
        raise ValueError(f"{path} is not a file of parameters: {error}") from error
