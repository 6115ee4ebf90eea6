"""Parameters of trained agents as single files, and those that are shipped.

A file is a NumPy archive: the arrays of the parameters, named by their place, and a header
in JSON with the settings that they were trained with and a digest of the arrays.
"""

import importlib.resources
import json
import os
import zipfile
import zlib
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from agents.acting.policy import Policy
from agents.config import Config
from agents.networks.agent import PARTS, Agent
from agents.runs.checkpoint import Arrays, digest, from_arrays, to_arrays

FORMAT = "trap-tube-jax parameters 1"
SUFFIX = ".npz"
HEADER = "header"
HEADER_VALUES = ("format", "config", "iteration", "digest")


def save(path: Path, policy: Policy, *, half: bool = False) -> None:
    """Writes a policy to a file, whole or not at all.

    Args:
      path: the file.
      policy: what to write; its name is not kept.
      half: round to float16, for half the size.
    """
    arrays = to_arrays(policy.params)
    if half:
        arrays = {name: array.astype(np.float16) for name, array in arrays.items()}
    header = {
        "format": FORMAT,
        "config": policy.config.to_dict(),
        "iteration": policy.iteration,
        "digest": digest(arrays),
    }
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    with draft.open("wb") as file:
        np.savez_compressed(file, **{HEADER: np.array(json.dumps(header))}, **arrays)  # pyright: ignore[reportArgumentType]
    draft.replace(path)


def load(path: Path | Traversable) -> Policy:
    """The policy of a file that `save` wrote, its parameters as float32.

    Args:
      path: the file; its name is the policy's.

    Raises:
      ValueError: the file is damaged, of another kind, or of settings that this version
        does not know.
      OSError: the file cannot be opened.
    """
    header, arrays = _read(path)
    try:
        config = Config.from_dict(header["config"])
        wanted = tuple(f"{part}/" for part in PARTS)
        arrays = {
            name: array.astype(np.float32)
            for name, array in arrays.items()
            if name.startswith(wanted)
        }
        template = jax.eval_shape(Agent(config).init, jax.random.key(0))
        params = from_arrays(arrays, template)
    except ValueError as error:
        raise ValueError(f"{path} does not fit this version: {error}") from error
    return Policy(path.name.removesuffix(SUFFIX), config, params, header["iteration"])


def names() -> tuple[str, ...]:
    """The names of the shipped parameters."""
    files = (entry.name for entry in _folder().iterdir())
    return tuple(sorted(file.removesuffix(SUFFIX) for file in files if file.endswith(SUFFIX)))


def load_shipped(name: str) -> Policy:
    """The shipped policy of this name.

    Raises:
      ValueError: there is none, or it is damaged.
    """
    if name not in names():
        raise ValueError(f"unknown parameters {name!r}; allowed: {', '.join(names()) or 'none'}")
    return load(_folder() / f"{name}{SUFFIX}")


def _folder() -> Traversable:
    return importlib.resources.files(__name__)


def _read(path: Path | Traversable) -> tuple[dict[str, Any], Arrays]:
    with path.open("rb") as file:
        try:
            with np.load(file, allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files}
            header = json.loads(str(arrays.pop(HEADER)))
            known = isinstance(header, dict) and header.get("format") == FORMAT
        except (ValueError, KeyError, EOFError, TypeError, AttributeError) as error:
            raise ValueError(f"{path} is not a file of parameters") from error
        except (zipfile.BadZipFile, zlib.error, OSError) as error:
            raise ValueError(f"{path} is damaged, or not a file of parameters: {error}") from error
    if not known or not set(HEADER_VALUES) <= set(header):
        raise ValueError(f"{path} is not a file of parameters")
    if digest(arrays) != header["digest"]:
        raise ValueError(f"{path} is damaged: it does not hold the numbers that were saved")
    return header, arrays
