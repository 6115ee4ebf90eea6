"""Pytrees as flat tables of named NumPy arrays, and safetensors files of such tables.

Reading a file runs no code from it.
"""

import json
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy

from agents.files import naming_file, write_bytes

Tree = TypeVar("Tree")
Arrays = dict[str, np.ndarray]

SUFFIX = ".safetensors"


def to_arrays(tree: Any) -> Arrays:
    """Copies every leaf to a NumPy array named by its path; PRNG keys become their key data."""
    leaves, _ = jax.tree.flatten_with_path(tree)
    # A copy: on a CPU the array could be a view of memory that is donated next.
    return {_name(path): np.array(key_data(leaf)) for path, leaf in leaves}


def from_arrays(arrays: Arrays, template: Tree) -> Tree:
    """Inverts `to_arrays`.

    Args:
      arrays: one array per leaf of the template.
      template: a pytree of arrays or of `jax.ShapeDtypeStruct`; its keys are of JAX's default kind.

    Raises:
      ValueError: a name, shape or dtype differs; the message names it.
    """
    leaves, structure = jax.tree.flatten_with_path(template)
    names = [_name(path) for path, _ in leaves]
    for name in sorted(set(names) ^ set(arrays)):
        raise ValueError(f"{name} is {'missing' if name in names else 'not expected'}")
    return structure.unflatten(
        [_to_leaf(name, arrays[name], leaf) for name, (_, leaf) in zip(names, leaves, strict=True)]
    )


def write_arrays(path: Path, arrays: Arrays, about: dict[str, Any]) -> None:
    """Writes arrays, and plain values about them as JSON in the header, atomically."""
    # One entry, because safetensors writes several in any order.
    write_bytes(path, safetensors.numpy.save(arrays, {"json": json.dumps(about)}))


def read_arrays(path: Path) -> tuple[Arrays, dict[str, Any]]:
    """Inverts `write_arrays`.

    Raises:
      ValueError: the file is damaged or of another kind; the message names it.
      OSError: the file is missing or cannot be opened.
    """
    with path.open("rb"):  # safetensors calls an unreadable file missing
        pass
    with naming_file(path), safetensors.safe_open(path, framework="numpy") as file:
        about = json.loads(file.metadata()["json"])
        return {name: file.get_tensor(name) for name in list(file.keys())}, about


def key_data(x: jax.Array) -> jax.Array:
    """Returns the integers of typed keys; other arrays unchanged."""
    return jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x


def _name(path: Any) -> str:
    return jax.tree_util.keystr(path, simple=True, separator="/")


def _to_leaf(name: str, array: np.ndarray, template: Any) -> jax.Array:
    wanted = jax.eval_shape(key_data, template)
    if (array.dtype, array.shape) != (wanted.dtype, wanted.shape):
        raise ValueError(
            f"{name} is {array.dtype}{list(array.shape)}, not {wanted.dtype}{list(wanted.shape)}"
        )
    leaf = jnp.asarray(array)
    return leaf if wanted.dtype == template.dtype else jax.random.wrap_key_data(leaf)
