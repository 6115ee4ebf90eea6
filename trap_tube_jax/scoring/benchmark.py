"""Scores of any agent by the benchmark's protocol, in one call.

Source: protocol.md.
"""

import functools
import zlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from trap_tube_jax.checks import check_integer, check_seed, describe_array, integer_array
from trap_tube_jax.environment import Environment
from trap_tube_jax.objects import NUM_DIRECTIONS
from trap_tube_jax.observation import observe
from trap_tube_jax.registry import TaskSet, task_set
from trap_tube_jax.scoring.python_agent import PythonAgent
from trap_tube_jax.scoring.scores import Scores
from trap_tube_jax.scoring.suite import Suite, play_blocks
from trap_tube_jax.scoring.tasks import ALL_SETS
from trap_tube_jax.solver.search import solve_batch
from trap_tube_jax.state import State, take


class _Ends(NamedTuple):
    """The ends of B episodes; see `Outcome`."""

    solved: np.ndarray
    length: np.ndarray


Play = Callable[[TaskSet, State], _Ends]  # plays B tasks of a set


class Policy(Protocol):
    """A policy for `score`: two pure functions of B episodes."""

    def initial(self, batch: int) -> Any:
        """Returns the memory of `batch` episodes before their first step, any pytree of arrays."""

    def act(self, observation: jax.Array, carry: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        """Chooses actions; compiled once.

        Args:
          observation: u8[B, 12, 12, N].
          carry: `initial(B)` at the first step, then the carry of the last call.
          key: PRNG key of the policy's draws.

        Returns:
          Actions integer[B, 2], (grasp, move), and the next carry of the same structure, shapes
          and types.
        """
        ...


class _Episodes(NamedTuple):
    """B episodes in play.

    Attributes:
      time: i32[], steps taken.
      states: B states.
      observation: u8[B, 12, 12, N].
      carry: the policy's memory.
      in_range: bool[B], all actions of the unfinished episode were in range.
    """

    time: jax.Array
    states: State
    observation: jax.Array
    carry: Any
    in_range: jax.Array


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

    Returns:
      The scores by set; printed, a table.

    Raises:
      ValueError: an argument is invalid, or the policy returns an action out of range or of NumPy.

    Example:
      >>> class Still:
      ...     def initial(self, batch):
      ...         return jnp.zeros((batch, 2), int)
      ...     def act(self, observation, carry, key):
      ...         return carry, carry
      >>> tt.score(Still(), sets=("base",), tasks=1)["base"].percent
      0.0
    """
    for name in ("initial", "act"):
        if not callable(getattr(policy, name, None)):
            raise ValueError(
                f"a policy has initial(batch) and act(observation, carry, key); "
                f"{type(policy).__name__} has no {name}; an agent in plain Python is for "
                "score_gymnasium"
            )
    seed = check_seed(seed)
    program = jax.jit(functools.partial(_play, policy), static_argnums=0)

    def play(entry: TaskSet, states: State) -> _Ends:
        env = Environment(max_steps=entry.max_steps)  # states hold their tasks
        key = jax.random.fold_in(jax.random.key(seed), zlib.crc32(entry.id.encode()))

        def play_block(block: State, start: int) -> tuple[jax.Array, ...]:
            return program(env, block, jax.random.fold_in(key, start))

        solved, length, in_range = play_blocks(play_block, states)
        if not np.all(in_range):
            raise ValueError(
                f"the policy's act returned an invalid action on {entry.label}; allowed: "
                f"(grasp, move), each in 0 to {NUM_DIRECTIONS - 1}"
            )
        return _Ends(np.asarray(solved), np.asarray(length))

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
        `reset()`, if it has one, is called before every episode. A model that Stable-Baselines3
        trained behind `VecNormalize` gets observations that are normalised likewise.
      sets: as for `score`.
      tasks: as for `score`.
      optimality: as for `score`.
      num_features: as for `score`.

    Returns:
      The scores by set; printed, a table.

    Raises:
      ValueError: an argument is invalid, the agent acts on observations of another dtype, or it
        returns an invalid action.

    Example:
      >>> class Still:
      ...     def act(self, observation):
      ...         return 0, 0
      >>> tt.score_gymnasium(Still(), sets=("base",), tasks=1)["base"].percent
      0.0
    """
    caller = PythonAgent(agent)

    def play(entry: TaskSet, states: State) -> _Ends:
        step = _compiled_step(Environment(max_steps=entry.max_steps))
        states = jax.device_get(states)
        ends = [caller.play(step, take(states, index)) for index in range(len(states.time))]
        solved, length = zip(*ends, strict=True)
        return _Ends(np.array(solved), np.array(length, np.int32))

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
    suite = Suite.of_sets(sets, tasks, num_features=num_features)
    ends = {name: play(task_set(name), states) for name, states in suite.tasks.items()}
    shortest = None
    if optimality:
        first = {name: take(states, slice(optimality)) for name, states in suite.tasks.items()}
        shortest = {name: solve_batch(states).length for name, states in first.items()}
    return suite.scores(ends, shortest=shortest, seed=seed)


def _play(
    policy: Policy, env: Environment, states: State, key: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Plays B tasks in lockstep until all are over.

    Returns:
      Solved bool[B]; steps taken i32[B]; bool[B], all actions of the unfinished episode were in
      range.
    """
    batch = len(states.time)

    def step(now: _Episodes) -> _Episodes:
        step_key = jax.random.fold_in(key, now.time)
        action, carry = _pair(policy.act(now.observation, now.carry, step_key), batch)
        states, timestep = jax.vmap(env.step)(now.states, action)
        in_range = jnp.all((action >= 0) & (action < NUM_DIRECTIONS), axis=-1)
        return _Episodes(
            time=now.time + 1,
            states=states,
            observation=timestep.observation,
            carry=carry,
            in_range=now.in_range & (in_range | now.states.done),
        )

    first = _Episodes(
        time=jnp.int32(0),
        states=states,
        observation=jax.vmap(observe)(states),
        carry=policy.initial(batch),
        in_range=jnp.ones(batch, bool),
    )
    last = jax.lax.while_loop(lambda now: ~jnp.all(now.states.done), step, first)
    return last.states.terminated, last.states.time, last.in_range


def _pair(returned: Any, batch: int) -> tuple[jax.Array, Any]:
    """Returns the result of a policy's act if it is a pair of actions and carry."""
    if not isinstance(returned, tuple | list) or len(returned) != 2:
        raise ValueError(
            "the policy's act must return a pair (actions i32[B, 2], carry), with carry = () for a "
            f"policy without memory, got {type(returned).__name__}"
        )
    action, carry = returned
    if isinstance(action, np.ndarray):
        raise ValueError(
            "the policy's act must compute actions by JAX: NumPy's would be the same at every step "
            "of the compiled program; score_gymnasium takes agents in plain Python"
        )
    action = integer_array("the policy's action", action)
    if action.shape != (batch, 2):
        raise ValueError(
            f"the policy's act must return actions integer{[batch, 2]}, (grasp, move) each, got "
            f"{describe_array(action)}; action_from_index converts 4 * grasp + move"
        )
    return jnp.asarray(action), carry


@functools.cache
def _compiled_step(env: Environment) -> Callable[..., Any]:
    return jax.jit(env.step)
