"""The fixed tasks on which policies are compared, drawn with keys that training never draws.

Training may still have seen an evaluation task: base is one task, {Sy} has five, {St} and
{St, Sy} one and five layouts in any colours.

Source: protocol.md, "Tasks".
"""

import functools
import zlib
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from trap_tube_jax.checks import MAX_TASKS, check_integer
from trap_tube_jax.environment import Environment, are_known
from trap_tube_jax.positions import colorless_rows
from trap_tube_jax.registry import PAPER_TASK_SETS, make, registered_ids, task_set
from trap_tube_jax.state import State, validate_batch
from trap_tube_jax.transfers import Transfer, compose, perceptual

Purpose = Literal["test", "validation", "confirmation"]

# The version of the fixed tasks. Scores of different versions are not comparable.
PROTOCOL = 1
ALL_SETS = tuple(entry.short for entry in PAPER_TASK_SETS)
FEW_LAYOUTS = 5  # a set with at most this many layouts, colours aside, has few
SETS_OF_FEW = tuple(x.short for x in PAPER_TASK_SETS if perceptual not in x.transfers)
SETS_OF_MANY = frozenset(ALL_SETS).difference(SETS_OF_FEW)

# "trap", and the first letters of "tube", "validation" and "confirmation". The first word of
# `jax.random.key(seed)` is 0 for every seed from 0 to 2**32 - 1, so no seed of training leads here.
_ROOTS: dict[Purpose, np.ndarray] = {
    "test": np.array([0x74726170, 0x74756265], np.uint32),
    "validation": np.array([0x74726170, 0x76616C69], np.uint32),
    "confirmation": np.array([0x74726170, 0x636F6E66], np.uint32),
}


def evaluation_tasks(
    name: str, num_tasks: int, num_features: int | None = None, purpose: Purpose = "test"
) -> State:
    """Returns the fixed evaluation tasks of a registered set: B states, the same at every call.

    B is `num_tasks`, or 1 for a set without transfers, whose tasks are all the same.

    Args:
      name: the set's id or short name.
      num_tasks: 1 to 1,000,000.
      num_features: N, feature channels; see `make`.
      purpose: `test` for tasks that are reported, `validation` for early stopping and model
        selection, `confirmation` for tasks that nobody has looked at before the work is done.

    Raises:
      ValueError: an argument is invalid; the message says what is allowed.

    Example:
      >>> tasks = tt.evaluation_tasks("sy", 100)
      >>> tasks.agent.shape, tasks.board.shape
      ((100, 2), (100, 12, 12))
    """
    return fixed_tasks(make(name, num_features=num_features), task_set(name).id, num_tasks, purpose)


def fixed_tasks(env: Environment, name: str, num_tasks: int, purpose: Purpose = "test") -> State:
    """Returns the evaluation tasks of any environment; other names give other tasks.

    They are the tasks that `env.reset` draws from `evaluation_keys(name, B, purpose)` under
    `jax_threefry_partitionable`, JAX's default, whatever the setting is here.

    Raises:
      ValueError: `num_tasks` is not from 1 to 1,000,000, `purpose` is unknown, or a custom transfer
        draws an invalid task.
    """
    check_integer("the number of evaluation tasks", num_tasks, maximum=MAX_TASKS)
    count = num_tasks if env.transfers else 1
    # Transfers are compiled one by one: the sets share them, so eight sets take three
    # compilations, and a transfer has the same bits in all of them.
    draw = compose(*map(_compiled, env.transfers))
    base = jax.tree.map(lambda x: np.broadcast_to(x, (count, *x.shape)), env.base)
    keys = evaluation_keys(name, count, purpose)
    with jax.threefry_partitionable(True):  # the user's setting must not choose other tasks
        tasks = jax.device_put(jax.vmap(draw)(keys, base))
    if not are_known(env.transfers):
        validate_batch(tasks, count, f"task set {name}")
    return tasks


def evaluation_keys(name: str, num_tasks: int, purpose: Purpose = "test") -> jax.Array:
    """Returns the PRNG keys [B] of the evaluation tasks of the set with this id.

    The first keys do not depend on `num_tasks`. Keys differ between sets and purposes.

    Raises:
      ValueError: `purpose` is unknown.
    """
    if purpose not in tuple(_ROOTS):
        raise ValueError(f"purpose must be one of {', '.join(_ROOTS)}, got {purpose!r}")
    return _keys(jnp.asarray(_ROOTS[purpose]), np.uint32(zlib.crc32(name.encode())), num_tasks)


@functools.partial(jax.jit, static_argnums=2)
def _keys(root: jax.Array, number: jax.typing.ArrayLike, num_tasks: int) -> jax.Array:
    set_key = jax.random.fold_in(jax.random.wrap_key_data(root, impl="threefry2x32"), number)
    indices = jnp.arange(num_tasks, dtype=jnp.uint32)
    return jax.vmap(jax.random.fold_in, in_axes=(None, 0))(set_key, indices)


def layout_numbers(name: str, tasks: State) -> np.ndarray | None:
    """Numbers the layouts of tasks from 0, i32[B]; returns None unless the set has few.

    A layout is a state without its colours. A set other than the paper's has few if these tasks
    have at most `FEW_LAYOUTS` layouts, and a layout occurs twice or there is only one task. A
    mixture with a set of the paper that has many has many.

    Args:
      name: the short name of a set or mixture.
      tasks: B states at time 0.
    """
    if not SETS_OF_MANY.isdisjoint(name.split("+")):
        return None
    rows = np.asarray(colorless_rows(tasks))
    found, layout = np.unique(rows, axis=0, return_inverse=True)
    few = len(found) <= FEW_LAYOUTS and len(found) < max(len(rows), 2)
    return layout.reshape(-1).astype(np.int32) if few or name in SETS_OF_FEW else None


def label(name: str) -> str:
    """Returns a set's or mixture's name in the paper's notation; keeps unregistered names."""
    known = {entry.short: entry.label for entry in map(task_set, registered_ids())}
    return " + ".join(known.get(part, part) for part in name.split("+"))


@functools.cache
def _compiled(transfer: Transfer) -> Transfer:
    return jax.jit(transfer)
