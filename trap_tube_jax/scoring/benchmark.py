"""Scores of any agent by the benchmark's protocol, in one call.

Source: protocol.md.
"""

import functools
import inspect
import zlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from trap_tube_jax._version import __version__
from trap_tube_jax.checks import check_integer, check_seed, described, integer_array
from trap_tube_jax.environment import Environment
from trap_tube_jax.objects import NUM_ACTIONS, NUM_DIRECTIONS
from trap_tube_jax.observation import observe
from trap_tube_jax.registry import TaskSet, make, task_set
from trap_tube_jax.scoring.scores import Optimality, Score, Scores
from trap_tube_jax.scoring.tasks import (
    ALL_SETS,
    PROTOCOL,
    fixed_tasks,
    label,
    layout_numbers,
)
from trap_tube_jax.solver.search import solve_batch
from trap_tube_jax.state import State, take

BLOCK = 1024  # tasks played at once, which bounds the memory

# Maps a set and B of its tasks to solved bool[B] and the steps taken i32[B].
Play = Callable[[TaskSet, State], tuple[np.ndarray, np.ndarray]]


class Policy(Protocol):
    """A policy for `score`: two pure functions of B episodes."""

    def initial(self, batch: int) -> Any:
        """Returns the memory of `batch` episodes before their first step, any pytree of arrays."""

    def act(self, observation: jax.Array, carry: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        """Chooses actions.

        Args:
          observation: u8[B, 12, 12, N].
          carry: `initial(B)` at the first step, then the carry of the last call.
          key: PRNG key of the policy's draws.

        Returns:
          Actions integer[B, 2], (grasp, move), and the next carry of the same structure, shapes
          and types, without NaN.
        """
        ...


class _Episodes(NamedTuple):
    """B episodes in play. The flags say whether all actions and memory so far were valid."""

    time: jax.Array
    states: State
    observation: jax.Array
    carry: Any
    in_range: jax.Array
    is_number: jax.Array


def score(
    policy: Policy,
    sets: Sequence[str] = ALL_SETS,
    tasks: int = 1000,
    *,
    seed: int = 0,
    optimality: int = 0,
    num_features: int | None = None,
) -> Scores:
    """Plays the fixed tasks of every set once, and counts the solved ones. Each call compiles.

    Args:
      policy: an object with the functions of `Policy`, such as `agents.load` returns.
      sets: ids or short names; the paper's eight if absent.
      tasks: tasks per set, 1 to 1,000,000. A set without transfers has one.
      seed: seed of the policy's draws, 0 to 2**32 - 1.
      optimality: number of tasks per set, the first ones, to compare with shortest plans.
      num_features: N, feature channels of the observation; see `make`.

    Raises:
      ValueError: an argument is invalid; the policy returns an action out of range, or its memory
        becomes NaN.
    """
    for name in ("initial", "act"):
        if not callable(getattr(policy, name, None)):
            raise ValueError(
                f"a policy has initial(batch) and act(observation, carry, key); "
                f"{type(policy).__name__} has no {name}"
            )
    seed = check_seed(seed)
    program = jax.jit(functools.partial(_play, policy), static_argnums=0)

    def play(entry: TaskSet, states: State) -> tuple[np.ndarray, np.ndarray]:
        env = Environment(max_steps=entry.max_steps)  # states hold their tasks
        key = jax.random.fold_in(jax.random.key(seed), zlib.crc32(entry.id.encode()))
        total = len(states.time)
        played = [
            program(env, take(states, block), jax.random.fold_in(key, block[0]))
            for block in blocks(total)
        ]
        solved, length, in_range, is_number = zip(*played, strict=True)
        if not np.all(in_range):
            raise ValueError(
                f"the policy's act returned an invalid action on {entry.label}; allowed: "
                f"(grasp, move), each in 0 to {NUM_DIRECTIONS - 1}"
            )
        if not np.all(is_number):
            raise ValueError(
                f"the policy's act returned a carry with NaN on {entry.label}; check that its "
                "parameters are finite"
            )
        return np.concatenate(solved)[:total], np.concatenate(length)[:total]

    return _scores(play, sets, tasks, seed, optimality, num_features)


def score_gymnasium(
    agent: Any,
    sets: Sequence[str] = ALL_SETS,
    tasks: int = 1000,
    *,
    optimality: int = 0,
    num_features: int | None = None,
) -> Scores:
    """Scores an agent in plain Python, which acts on one observation at a time; see `score`.

    Args:
      agent: an object with `predict(observation)` or `act(observation)`, which takes
        u8[12, 12, N] and returns (grasp, move) or 4 * grasp + move. A function that takes
        `state` besides the observation gets None at first and returns the action and the next
        state, as in Stable-Baselines3. A function that takes `deterministic` gets True. An agent's
        `reset()`, if it has one, is called before every episode.
      sets: as for `score`.
      tasks: as for `score`.
      optimality: as for `score`.
      num_features: as for `score`.

    Raises:
      ValueError: an argument is invalid, or the agent returns an invalid action.
    """
    act = getattr(agent, "predict", None) or getattr(agent, "act", None)
    if not callable(act):
        raise ValueError(
            f"an agent has predict(observation) or act(observation); {type(agent).__name__} has "
            "neither"
        )

    def play(entry: TaskSet, states: State) -> tuple[np.ndarray, np.ndarray]:
        step = _compiled_step(Environment(max_steps=entry.max_steps))
        states = jax.device_get(states)
        ends = [_play_one(agent, act, step, take(states, i)) for i in range(len(states.time))]
        solved, length = zip(*ends, strict=True)
        return np.array(solved), np.array(length, np.int32)

    return _scores(play, sets, tasks, None, optimality, num_features)


def _scores(
    play: Play,
    sets: Sequence[str],
    tasks: int,
    seed: int | None,
    optimality: int,
    num_features: int | None,
) -> Scores:
    """Scores every set, and compares its first `optimality` tasks with shortest plans."""
    if isinstance(sets, str) or not sets:
        raise ValueError(f"sets must name task sets, such as {', '.join(ALL_SETS)}, got {sets!r}")
    check_integer("optimality", optimality, minimum=0)
    made, entries = [], [task_set(name) for name in sets]
    # All before the first is played, so that a wrong one costs nothing.
    envs = [make(entry.short, num_features=num_features) for entry in entries]
    for entry, env in zip(entries, envs, strict=True):
        states = fixed_tasks(env, entry.id, tasks)
        solved, length = play(entry, states)
        shortest = solve_batch(take(states, slice(optimality))).length if optimality else None
        made.append(score_of(entry.short, states, solved, length, entry.max_steps, shortest))
    return Scores(PROTOCOL, __version__, seed, tuple(made))


def score_of(
    name: str,
    states: State,
    solved: np.ndarray,
    length: np.ndarray,
    max_steps: int,
    shortest: np.ndarray | None = None,
) -> Score:
    """Computes the score of outcomes bool[B] and numbers of steps i32[B] on B tasks of a set.

    `shortest` has the lengths of the first tasks' shortest plans, to compare with.
    """
    found = None
    if shortest is not None:
        part = slice(len(shortest))
        found = Optimality.of(solved[part], length[part], shortest, max_steps)
    layout = layout_numbers(name, states)
    return Score.of(name, label(name), solved, length, layout=layout, optimality=found)


def blocks(total: int) -> list[np.ndarray]:
    """Returns the indices of `total` tasks in blocks i64[b] that are played at once.

    All blocks have one size, the smaller of `BLOCK` and `total`, so that they share a compilation.
    The last block is filled up with the first tasks.
    """
    size = min(BLOCK, total)
    return [np.arange(start, start + size) % total for start in range(0, total, size)]


def _play(
    policy: Policy, env: Environment, states: State, key: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Plays B tasks in lockstep until all are over.

    Returns:
      Solved bool[B]; steps taken i32[B]; bool[], all actions of unfinished episodes were in
      range; bool[], the policy's memory held no NaN.
    """

    def step(now: _Episodes) -> _Episodes:
        step_key = jax.random.fold_in(key, now.time)
        batch = len(now.observation)
        action, carry = _pair(policy.act(now.observation, now.carry, step_key), batch)
        expected, got = (jax.tree.structure(each) for each in (now.carry, carry))
        if got != expected:
            raise ValueError(
                f"the policy's act must return a carry like that of initial, {expected}, got {got}"
            )
        states, timestep = jax.vmap(env.step)(now.states, action)
        in_range = jnp.all((action >= 0) & (action < NUM_DIRECTIONS), axis=-1)
        return _Episodes(
            time=now.time + 1,
            states=states,
            observation=timestep.observation,
            carry=carry,
            in_range=now.in_range & jnp.all(in_range | now.states.done),
            is_number=now.is_number & ~_has_nan(carry),
        )

    first = _Episodes(
        time=jnp.int32(0),
        states=states,
        observation=jax.vmap(observe)(states),
        carry=policy.initial(len(states.time)),
        in_range=jnp.array(True),
        is_number=jnp.array(True),
    )
    last = jax.lax.while_loop(lambda now: ~jnp.all(now.states.done), step, first)
    return last.states.terminated, last.states.time, last.in_range, last.is_number


def _has_nan(tree: Any) -> jax.Array:
    leaves = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(jnp.result_type(x), jnp.floating)]
    return jnp.any(jnp.array([jnp.any(jnp.isnan(leaf)) for leaf in leaves], bool))


def _pair(returned: Any, batch: int) -> tuple[jax.Array, Any]:
    """Returns the result of a policy's act if it is a pair of actions and carry."""
    if not isinstance(returned, tuple | list) or len(returned) != 2:
        raise ValueError(
            "the policy's act must return a pair (actions i32[B, 2], carry), with carry = () for a "
            f"policy without memory, got {type(returned).__name__}"
        )
    action, carry = returned
    action = integer_array("the policy's action", action)
    if action.shape != (batch, 2):
        raise ValueError(
            f"the policy's act must return actions integer{[batch, 2]}, (grasp, move) each, got "
            f"{described(action)}; action_from_index converts 4 * grasp + move"
        )
    return jnp.asarray(action), carry


def _play_one(
    agent: Any, act: Callable[..., Any], step: Callable[..., Any], state: State
) -> tuple[bool, int]:
    """Plays one task; returns solved and the number of steps."""
    known = list(inspect.signature(act).parameters)[1:]  # without the observation
    options: dict[str, Any] = {"deterministic": True} if "deterministic" in known else {}
    if callable(getattr(agent, "reset", None)):
        agent.reset()
    observation, memory = np.array(observe(state)), None
    while not state.done:
        if "state" in known:
            action, memory = act(observation, state=memory, **options)
        else:
            action = act(observation, **options)
        state, timestep = step(state, _grasp_and_move(action))
        observation = np.array(timestep.observation)
    return bool(state.terminated), int(state.time)


def _grasp_and_move(action: Any) -> np.ndarray:
    """Converts (grasp, move) or 4 * grasp + move to i32[2]; raises ValueError for the rest."""
    try:
        array = np.asarray(action)
    except ValueError:  # ragged
        array = np.zeros(0)
    count = {1: NUM_ACTIONS, 2: NUM_DIRECTIONS}.get(array.size, 0)
    if not count or array.dtype.kind not in "iu" or array.min() < 0 or array.max() >= count:
        raise ValueError(
            f"an action is (grasp, move), each in 0 to {NUM_DIRECTIONS - 1}, or 4 * grasp + move, "
            f"in 0 to {NUM_ACTIONS - 1}; got {action!r}"
        )
    pair = array if array.size == 2 else np.stack(np.divmod(array, NUM_DIRECTIONS))
    return pair.reshape(2).astype(np.int32)


@functools.cache
def _compiled_step(env: Environment) -> Callable[..., Any]:
    return jax.jit(env.step)
