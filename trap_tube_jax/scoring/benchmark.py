"""The score of anybody's agent: the benchmark's protocol in one call.

Source: protocol.md.
"""

import functools
import inspect
import zlib
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from trap_tube_jax._version import __version__
from trap_tube_jax.checks import check_integer, check_seed
from trap_tube_jax.environment import Environment
from trap_tube_jax.objects import NUM_ACTIONS, NUM_DIRECTIONS
from trap_tube_jax.observation import observe
from trap_tube_jax.registry import TaskSet, task_set
from trap_tube_jax.scoring.scores import Optimality, Score, Scores
from trap_tube_jax.scoring.tasks import (
    ALL_SETS,
    PROTOCOL,
    evaluation_tasks,
    layout_numbers,
)
from trap_tube_jax.solver.search import solve_batch, take
from trap_tube_jax.state import State

BLOCK = 1024  # tasks played at once: bounds the memory, whatever their number

# Time, states, observations, the policy's carry, and whether all actions were in range so far.
_Now = tuple[jax.Array, State, jax.Array, Any, jax.Array]

# From a set and B of its tasks to solved bool[B] and the steps taken i32[B].
Play = Callable[[TaskSet, State], tuple[np.ndarray, np.ndarray]]


class Policy(Protocol):
    """What `score` plays with: two pure functions of B episodes."""

    def initial(self, batch: int) -> Any:
        """What the policy remembers before the first step of `batch` episodes, any pytree."""

    def act(self, observation: jax.Array, carry: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        """The actions i32[B, 2], (grasp, move), for observations u8[B, 12, 12, N].

        Args:
          observation: of every episode.
          carry: `initial(B)`, then what the last call returned.
          key: PRNG key of the policy's draws.

        Returns:
          The actions, and the next carry, of the same structure, shapes and types.
        """
        ...


def score(
    policy: Policy,
    sets: Sequence[str] = ALL_SETS,
    tasks: int = 1000,
    *,
    seed: int = 0,
    optimality: int = 0,
    num_features: int | None = None,
) -> Scores:
    """Plays the fixed tasks of every set once, compiled, and counts what is solved.

    Args:
      policy: an object with the functions of `Policy`; one of `agents.load`, for example.
      sets: ids or short names; the paper's eight if absent.
      tasks: how many of each set, at least 1. A set without transfers has one.
      seed: of the policy's draws, 0 to 2**32 - 1.
      optimality: how many of the first tasks of each set to compare with shortest plans, which
        are searched for first.
      num_features: N, feature channels of the observation; see `make`.

    Raises:
      ValueError: naming the argument and what is allowed, or an invalid action.
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
        env = _dynamics(entry.max_steps)
        key = jax.random.fold_in(jax.random.key(seed), zlib.crc32(entry.id.encode()))
        total = len(states.time)
        played = [
            program(env, take(states, block), jax.random.fold_in(key, block[0]))
            for block in blocks(total)
        ]
        solved, length, is_valid = zip(*played, strict=True)
        if not np.all(is_valid):
            raise ValueError(
                f"the policy's act returned an invalid action; allowed: (grasp, move), each in "
                f"0 to {NUM_DIRECTIONS - 1}"
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
    """As `score`, for an agent in plain Python that acts on one observation at a time.

    Args:
      agent: an object with `predict(observation)` or `act(observation)`, which is given
        u8[12, 12, N] and returns (grasp, move) or 4 * grasp + move. Where the function takes
        `state`, it gets None at first and returns the action and the next state, as in
        Stable-Baselines3. Where it takes `deterministic`, that is true. Where the agent has
        `reset()`, that is called before every episode.
      sets: as for `score`.
      tasks: as for `score`.
      optimality: as for `score`.
      num_features: as for `score`.

    Raises:
      ValueError: naming the argument and what is allowed, or an invalid action.
    """
    act = getattr(agent, "predict", None) or getattr(agent, "act", None)
    if not callable(act):
        raise ValueError(
            f"an agent has predict(observation) or act(observation); {type(agent).__name__} has "
            "neither"
        )

    def play(entry: TaskSet, states: State) -> tuple[np.ndarray, np.ndarray]:
        step = _compiled_step(entry.max_steps)
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
    """The score of every set; its first `optimality` tasks are compared with shortest plans."""
    if isinstance(sets, str) or not sets:
        raise ValueError(f"sets must name task sets, such as {', '.join(ALL_SETS)}, got {sets!r}")
    check_integer("optimality", optimality, minimum=0)
    made = []
    for entry in [task_set(name) for name in sets]:
        states = evaluation_tasks(entry.short, tasks, num_features)
        solved, length = play(entry, states)
        found = None
        if optimality:
            part = slice(optimality)
            shortest = solve_batch(take(states, part)).length
            found = Optimality.of(solved[part], length[part], shortest, entry.max_steps)
        layout = layout_numbers(entry.short, states)
        made.append(
            Score.of(entry.short, entry.label, solved, length, layout=layout, optimality=found)
        )
    return Scores(PROTOCOL, __version__, seed, tuple(made))


def blocks(total: int) -> list[np.ndarray]:
    """The indices of `total` tasks, in blocks i64[b] that are played at once.

    All are of one size, the smaller of `BLOCK` and `total`, so that they share a compilation: after
    the last task the last block goes on with the first ones.
    """
    size = min(BLOCK, total)
    return [np.arange(start, start + size) % total for start in range(0, total, size)]


def _play(
    policy: Policy, env: Environment, states: State, key: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Plays B tasks side by side until all are over.

    Returns:
      Solved bool[B], the steps taken i32[B], and whether all actions of episodes that were not
      over were in range, bool[].
    """

    def step(now: _Now) -> _Now:
        time, states, observation, carry, is_valid = now
        over = states.terminated | states.truncated
        action, carry = _pair(policy.act(observation, carry, jax.random.fold_in(key, time)))
        states, timestep = jax.vmap(env.step)(states, action)
        in_range = jnp.all((action >= 0) & (action < NUM_DIRECTIONS), axis=-1)
        return time + 1, states, timestep.observation, carry, is_valid & jnp.all(in_range | over)

    def is_on(now: _Now) -> jax.Array:
        return ~jnp.all(now[1].terminated | now[1].truncated)

    first = (
        jnp.int32(0),
        states,
        jax.vmap(observe)(states),
        policy.initial(len(states.time)),
        jnp.array(True),
    )
    _, states, _, _, is_valid = jax.lax.while_loop(is_on, step, first)
    return states.terminated, states.time, is_valid


def _pair(returned: Any) -> tuple[jax.Array, Any]:
    """What a policy's act returned, if it is a pair."""
    if not isinstance(returned, tuple | list) or len(returned) != 2:
        raise ValueError(
            "the policy's act must return a pair (actions i32[B, 2], carry), with carry = () where "
            f"nothing is remembered, got {type(returned).__name__}"
        )
    return returned[0], returned[1]


def _play_one(
    agent: Any, act: Callable[..., Any], step: Callable[..., Any], state: State
) -> tuple[bool, int]:
    """Plays one task: whether it is solved, and the steps taken."""
    known = inspect.signature(act).parameters
    options: dict[str, Any] = {"deterministic": True} if "deterministic" in known else {}
    if callable(getattr(agent, "reset", None)):
        agent.reset()
    observation, memory = np.array(observe(state)), None
    while not (state.terminated or state.truncated):
        if "state" in known:
            action, memory = act(observation, state=memory, **options)
        else:
            action = act(observation, **options)
        state, timestep = step(state, _grasp_and_move(action))
        observation = np.array(timestep.observation)
    return bool(state.terminated), int(state.time)


def _grasp_and_move(action: Any) -> np.ndarray:
    """i32[2] of (grasp, move), or of 4 * grasp + move; raises ValueError for anything else."""
    array = np.asarray(action)
    count = {1: NUM_ACTIONS, 2: NUM_DIRECTIONS}.get(array.size, 0)
    if not count or array.dtype.kind not in "iu" or array.min() < 0 or array.max() >= count:
        raise ValueError(
            f"an action is (grasp, move), each in 0 to {NUM_DIRECTIONS - 1}, or 4 * grasp + move, "
            f"in 0 to {NUM_ACTIONS - 1}; got {action!r}"
        )
    pair = array if array.size == 2 else np.stack(np.divmod(array, NUM_DIRECTIONS))
    return pair.reshape(2).astype(np.int32)


@functools.cache
def _dynamics(max_steps: int) -> Environment:
    """The rules under a step limit; states bring their tasks along."""
    return Environment(max_steps=max_steps)


@functools.cache
def _compiled_step(max_steps: int) -> Callable[..., Any]:
    return jax.jit(_dynamics(max_steps).step)
