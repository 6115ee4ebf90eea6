"""Breadth-first search over a task's graph, and shortest plans.

A node of the graph is a position, as `trap_tube_jax.positions` numbers them.

Source: environment.md, "One step".
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.core import Tracer

from trap_tube_jax import dynamics
from trap_tube_jax.by_value import ByValue
from trap_tube_jax.environment import action_from_index
from trap_tube_jax.geometry import cell_of
from trap_tube_jax.objects import NO_DIRECTION, NUM_ACTIONS
from trap_tube_jax.positions import NUM_CELLS, NUM_POSITIONS, colorless_rows, position_id
from trap_tube_jax.state import State, check_is_state, take, validate

# Frontiers are padded to one of few sizes, because every size compiles.
CHUNK_SIZES = (256, 1024, 4096)


class Plan(ByValue, struct.PyTreeNode, eq=False):
    """A shortest plan in NumPy arrays, or the proof that none exists.

    Ties go to the first plan in the order of action indices (4 * grasp + move), compared step by
    step.

    Attributes:
      actions: i32[L, 2], the (grasp, move) of every step. In a batch i32[B, L, 2] with the
        longest length L; shorter plans end in (-1, -1), which moves nothing. Outside jit
        `Environment.step` refuses this padding.
      length: i32[] or i32[B], number of steps, which may exceed a step limit; -1 if unsolvable.
      solvable: bool[] or bool[B], some sequence of actions leads to the goal.

    Example:
      >>> env = tt.make("base")
      >>> state, timestep = env.reset(jax.random.key(0))
      >>> for action in tt.solve(state).actions:
      ...     state, timestep = env.step(state, action)
      >>> float(timestep.reward)
      1.0
    """

    actions: np.ndarray
    length: np.ndarray
    solvable: np.ndarray


class Level(NamedTuple):
    """All nodes at one distance from the start, and their successors.

    Attributes:
      nodes: i32[n], in the order of the first shortest plans that lead to them.
      successors: i32[n, 16], the nodes after the 16 actions.
      solved: bool[n, 16], the action solves the task.
      origin: i64[n], flat indices of the nodes' first occurrences in the previous level's
        `successors`; empty at the start.
    """

    nodes: np.ndarray
    successors: np.ndarray
    solved: np.ndarray
    origin: np.ndarray


def solve(state: State) -> Plan:
    """Finds the shortest plan of one task, exactly, for any valid state.

    Runs on the host, outside jit and vmap. Ignores colours and the step limit.

    Args:
      state: one unbatched state, at any time of an unfinished episode.

    Returns:
      The plan, whose last step earns the reward of `Environment.step`.

    Raises:
      ValueError: the state is invalid (see `validate`), done, batched or traced.

    Example:
      >>> plan = tt.solve(tt.base_state())
      >>> int(plan.length), plan.actions[:2].tolist()
      (11, [[0, 0], [0, 3]])
    """
    return _to_plan(_shortest_actions(validate_on_host(state)))


def solve_batch(states: State) -> Plan:
    """Finds the shortest plans of many tasks, as `solve` does for one.

    Args:
      states: states with one leading axis B, as from `jax.vmap(env.reset)`.

    Returns:
      The plans with a leading axis B, padded to the longest (see `Plan`).

    Raises:
      ValueError: `states` is not a batch, or `solve` refuses a state, whose index the message
        names.

    Example:
      >>> plans = tt.solve_batch(tt.evaluation_tasks("sy", 3))
      >>> plans.length.tolist(), plans.actions.shape
      ([8, 11, 11], (3, 11, 2))
    """
    tasks = list(_unbatched(states))
    # Tasks of a set may recur, and are solved once.
    found: dict[bytes, np.ndarray | None] = {}
    plans = []
    for state, row in zip(tasks, np.asarray(colorless_rows(states)), strict=True):
        task = row.tobytes()
        if task not in found:
            found[task] = _shortest_actions(state)
        plans.append(_to_plan(found[task]))
    length = np.array([plan.length for plan in plans])
    actions = np.full((len(plans), max(length.max(), 0), 2), NO_DIRECTION, np.int32)
    for row, plan in zip(actions, plans, strict=True):
        row[: len(plan.actions)] = plan.actions
    return Plan(actions, length, length >= 0)


def validate_on_host(state: State) -> State:
    """Returns a valid state as NumPy arrays; raises the errors of `solve`."""
    return validate(_to_host(state))


def levels(state: State) -> Iterator[Level]:
    """Yields the task's nodes by distance from the start, every node once.

    Solved nodes end an episode, so they appear only as successors. The search ends where no
    node is new; stop iterating to end it earlier.

    Args:
      state: a valid state of NumPy arrays.
    """
    # Colours play no part; without them there is one compilation for every N.
    layout = jax.device_put(state.replace(palette=np.zeros((0, 0), np.uint8)))
    nodes = np.array([position_id(state)], np.int32)
    origin = np.empty(0, np.int64)
    is_known = np.zeros(NUM_POSITIONS, bool)
    is_known[nodes] = True
    while len(nodes):
        successors, solved = _expand_all(layout, nodes)
        yield Level(nodes, successors, solved, origin)
        new = np.flatnonzero(~(is_known[successors] | solved))
        # Keeping first occurrences in their order gives the tie-break that `Plan` promises.
        _, first = np.unique(successors.reshape(-1)[new], return_index=True)
        origin = new[np.sort(first)]
        nodes = successors.reshape(-1)[origin]
        is_known[nodes] = True


def _shortest_actions(state: State) -> np.ndarray | None:
    """Returns the action indices i32[L] of the first shortest plan, or None."""
    origins = []
    for level in levels(state):
        origins.append(level.origin)
        if level.solved.any():
            return _trace_back(origins, int(np.argmax(level.solved)))
    return None


def _trace_back(origins: Sequence[np.ndarray], last: int) -> np.ndarray:
    """Returns the action indices i32[L] that lead to entry `last` of the last `successors`."""
    actions = [last % NUM_ACTIONS]
    for origin in origins[:0:-1]:
        last = int(origin[last // NUM_ACTIONS])
        actions.append(last % NUM_ACTIONS)
    return np.array(actions[::-1], np.int32)


def _expand_all(layout: State, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Expands nodes as `_expand` does, in chunks of few sizes."""
    parts = []
    for start in range(0, len(nodes), CHUNK_SIZES[-1]):
        chunk = nodes[start : start + CHUNK_SIZES[-1]]
        size = next(size for size in CHUNK_SIZES if size >= len(chunk))
        padded = np.resize(chunk, size)
        parts.append([array[: len(chunk)] for array in jax.device_get(_expand(layout, padded))])
    successors, solved = zip(*parts, strict=True)
    return np.concatenate(successors), np.concatenate(solved)


@jax.jit
def _expand(layout: State, nodes: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the successors i32[n, 16] of nodes i32[n], and bool[n, 16] where solved."""
    actions = action_from_index(jnp.arange(NUM_ACTIONS))

    def expand_node(node: jax.Array) -> tuple[jax.Array, jax.Array]:
        state = _state_at(layout, node)
        following = jax.vmap(lambda action: dynamics.step(state, action))(actions)
        return jax.vmap(position_id)(following), following.terminated

    return jax.vmap(expand_node)(nodes)


def _state_at(layout: State, node: jax.Array) -> State:
    """Returns the state of a node i32[], on the board and with the tool of `layout`."""
    agent_and_tool, food = jnp.divmod(node, NUM_CELLS)
    agent, tool = jnp.divmod(agent_and_tool, NUM_CELLS)
    return layout.replace(agent=cell_of(agent), tool=cell_of(tool), food=cell_of(food))


def _to_plan(indices: np.ndarray | None) -> Plan:
    is_solvable = indices is not None
    actions = action_from_index(indices if is_solvable else np.empty(0, np.int32))
    return Plan(
        actions=np.asarray(actions),
        length=np.array(len(actions) if is_solvable else -1, np.int32),
        solvable=np.array(is_solvable),
    )


def _unbatched(states: State) -> Iterator[State]:
    states = _to_host(states)
    if np.ndim(states.time) != 1 or not len(states.time):
        raise ValueError(
            "solve_batch takes states with one leading axis of at least 1, got a state whose "
            f"time has shape {np.shape(states.time)}; solve takes a single one"
        )
    for index in range(len(states.time)):
        try:
            yield validate_on_host(take(states, index))
        except (ValueError, IndexError) as error:
            raise ValueError(f"state {index} of the batch: {error}") from error


def _to_host(state: State) -> State:
    check_is_state(state)
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(state)):
        raise ValueError(
            "the solver runs on the host and got a traced state; call it outside jit, vmap and "
            "scan, with solve_batch for many states"
        )
    return jax.device_get(state)
