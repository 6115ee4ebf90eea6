"""The environment: a pure `reset` and a pure `step` over one task.

Source: paper, section "Environments"; environment.md.
"""

import copy
import dataclasses
from collections.abc import Iterable, Mapping, Set
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from trap_tube_jax import dynamics
from trap_tube_jax.by_value import ByValue
from trap_tube_jax.checks import check_integer, describe_array, integer_array
from trap_tube_jax.controls import CONTROLS, LayoutDraw
from trap_tube_jax.graded import GradedPerceptual, GradedStructural
from trap_tube_jax.objects import (
    BOARD_SIZE,
    DIRECTION_NAMES,
    MAX_STEPS,
    NO_DIRECTION,
    NUM_ACTIONS,
    NUM_DIRECTIONS,
)
from trap_tube_jax.observation import observe
from trap_tube_jax.state import (
    State,
    TimeStep,
    base_state,
    check_state,
    take,
    validate,
    validate_batch,
    with_narrow_integers,
)
from trap_tube_jax.transfers import (
    Composition,
    Transfer,
    compose,
    parts_of,
    perceptual,
    structural,
    symbolic,
    transfer_name,
)

MAX_TIME = 2**31 - 1  # `State.time` is an i32
NUM_TRIALS = 32  # of a custom transfer

_KNOWN = {perceptual, structural, symbolic, *map(LayoutDraw, CONTROLS)}


@dataclasses.dataclass(frozen=True)
class ArraySpec:
    """Shape, dtype and inclusive bounds of an array.

    Attributes:
      shape: lengths of the dimensions.
      dtype: NumPy dtype of the elements.
      minimum: smallest allowed element.
      maximum: largest allowed element.

    Example:
      >>> tt.make("p").action_spec
      ArraySpec(shape=(2,), dtype=dtype('int32'), minimum=0, maximum=3)
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    minimum: int
    maximum: int


class Environment(ByValue):
    """A distribution over tasks: a base state under a sequence of transfers.

    `reset` and `step` are pure and unbatched: jit, vmap and scan them. An environment holds no
    episode; everything that changes is in the `State`. Environments with equal transfers, base
    state and step limit are equal. To shard a batch, use a mesh of `Auto` axes, or `jax.shard_map`
    with `check_vma=False`.

    Example:
      >>> env = tt.Environment((tt.perceptual, tt.structural), max_steps=30)
      >>> state, timestep = env.reset(jax.random.key(0))
      >>> state, timestep = env.step(state, jnp.array([0, 3]))  # grasp up, move right
      >>> timestep.observation.shape, float(timestep.reward), bool(timestep.done)
      ((12, 12, 3), 0.0, False)
    """

    def __init__(
        self,
        transfers: Iterable[Transfer] = (),
        *,
        base: State | None = None,
        max_steps: int = MAX_STEPS,
    ):
        """Checks the arguments, and tries every custom transfer with 32 keys.

        A trial runs the transfer under jit and vmap, on the output of the transfers before it.

        Args:
          transfers: functions (key, state) -> state, applied in order at every reset,
            with different typed keys (`compose`).
          base: the state that the transfers start from, at time 0; the base task if absent.
          max_steps: steps after which an unsolved episode is truncated, 1 to 2**31 - 1.

        Raises:
          ValueError: naming the argument, its value and what is allowed.
        """
        has_order = isinstance(transfers, Iterable) and not isinstance(
            transfers, Set | Mapping | str
        )
        if callable(transfers) or not has_order:
            raise ValueError(
                f"transfers must be a sequence of functions (key, state) -> state, "
                f"got {transfers!r}"
            )
        self.max_steps = check_integer("max_steps", max_steps, maximum=MAX_TIME)
        self.transfers = Composition(tuple(transfers)).transfers  # which it checks
        custom = [not are_known([x]) for x in self.transfers]
        num_tried = len(custom) - custom[::-1].index(True) if any(custom) else 0
        with jax.ensure_compile_time_eval():  # an environment may be made in traced code
            self.base = base_state() if base is None else _check_base(base)
            if num_tried:
                states = jax.tree.map(lambda x: jnp.stack([x] * NUM_TRIALS), self.base)
                keys = jax.random.split(jax.random.key(0), NUM_TRIALS)
                for transfer in self.transfers[:num_tried]:
                    states = _try_transfer(transfer, jax.random.clone(keys), states)

    def __setattr__(self, name: str, value: Any) -> None:
        """Raises AttributeError if the attribute exists: compiled programs would not notice."""
        if name in vars(self):
            raise AttributeError(
                f"{name} of an environment is constant; make another one, as by with_max_steps"
            )
        super().__setattr__(name, value)

    def with_max_steps(self, max_steps: int) -> Self:
        """Returns an environment with another step limit, 1 to 2**31 - 1."""
        env = copy.copy(self)
        vars(env)["max_steps"] = check_integer("max_steps", max_steps, maximum=MAX_TIME)
        return env

    def reset(self, key: jax.Array) -> tuple[State, TimeStep]:
        """Draws a task.

        Args:
          key: PRNG key; the same key in the same program gives the same task, bit for bit. Between
            programs, such as a batch and a loop, a colour may differ by 1 in a task of thousands.

        Returns:
          The state at time 0, and a timestep with reward 0.

        Raises:
          ValueError: `key` is not one PRNG key.
        """
        # A copy: without transfers the base would be returned, and the caller may donate it.
        state = compose(*self.transfers)(key, jax.tree.map(jnp.copy, self.base))
        return state, _timestep(state, reward=jnp.zeros((), jnp.float32))

    def step(self, state: State, action: jax.Array) -> tuple[State, TimeStep]:
        """Takes one action, deterministically. A finished state does not change and pays 0.

        Args:
          state: one unbatched state.
          action: integer[2] = (grasp, move), each 0 up, 1 down, 2 left, 3 right. Values are not
            checked under jit, vmap or scan; there, any other value means no direction.

        Returns:
          The next state, and a timestep with reward 1 if this step solved the task.

        Raises:
          ValueError: `state` is not one unbatched state, the action's shape or dtype is wrong, or
            a concrete number is out of range.
        """
        check_state(state)
        action = check_actions(action, (2,))
        was_done = state.done
        state = dynamics.step(state, action)
        time = jnp.where(was_done, state.time, state.time + 1)
        truncated = state.truncated | (~state.terminated & (time >= self.max_steps))
        state = state.replace(time=time, truncated=truncated)
        reward = (state.terminated & ~was_done).astype(jnp.float32)
        return state, _timestep(state, reward)

    @property
    def num_features(self) -> int:
        """Number N of feature channels of the observation."""
        return self.base.palette.shape[-1]

    @property
    def num_actions(self) -> int:
        """Number of (grasp, move) pairs, 16."""
        return NUM_ACTIONS

    @property
    def observation_spec(self) -> ArraySpec:
        """Shape, dtype and bounds of the observation: u8[12, 12, N] in 0 to 255."""
        return ArraySpec((BOARD_SIZE, BOARD_SIZE, self.num_features), np.dtype(np.uint8), 0, 255)

    @property
    def action_spec(self) -> ArraySpec:
        """Shape, dtype and bounds of the action: i32[2] = (grasp, move) in 0 to 3."""
        return ArraySpec((2,), np.dtype(np.int32), 0, NUM_DIRECTIONS - 1)

    def __repr__(self) -> str:
        names = ", ".join(map(transfer_name, self.transfers))
        base = "" if self.base == base_state() else "base=..., "
        return f"{type(self).__name__}(transfers=({names}), {base}max_steps={self.max_steps})"


def action_from_index(index: jax.typing.ArrayLike) -> jax.Array:
    """Converts `4 * grasp + move`, an integer[...] in 0 to 15, to actions i32[..., 2].

    Any other number becomes (-1, -1), which are no directions.

    Raises:
      ValueError: `index` does not hold integers.

    Example:
      >>> tt.action_from_index(jnp.array([0, 6])).tolist()
      [[0, 0], [1, 2]]
    """
    return jnp.asarray(pairs_of(integer_array("index", index)))


def pairs_of(index: Any) -> Any:
    """Converts action indices integer[...] as `action_from_index` does; NumPy stays NumPy."""
    xp = np if isinstance(index, np.ndarray) else jnp
    is_known = (index >= 0) & (index < NUM_ACTIONS)
    index = index.astype(np.int32)
    action = xp.stack([index // NUM_DIRECTIONS, index % NUM_DIRECTIONS], -1)
    return xp.where(is_known[..., None], action, NO_DIRECTION)


def action_to_index(action: jax.typing.ArrayLike) -> jax.Array:
    """Converts actions integer[..., 2] to `4 * grasp + move`, i32[...] in 0 to 15.

    A pair with a value outside 0 to 3 becomes -1.

    Raises:
      ValueError: `action` does not hold pairs of integers.

    Example:
      >>> tt.action_to_index(jnp.array([[0, 0], [1, 2]])).tolist()
      [0, 6]
    """
    action = integer_array("action", action)
    if action.ndim == 0 or action.shape[-1] != 2:
        raise ValueError(
            f"action must be integer[..., 2] = (grasp, move), got {describe_array(action)}"
        )
    is_known = ((action >= 0) & (action < NUM_DIRECTIONS)).all(-1)
    grasp = action[..., 0].astype(np.int32)
    move = action[..., 1].astype(np.int32)
    return jnp.where(is_known, grasp * NUM_DIRECTIONS + move, NO_DIRECTION)


def check_actions(actions: Any, shape: tuple[int, ...]) -> jax.Array:
    """Checks dtype, shape and concrete values, and returns the actions as an array.

    Raises:
      ValueError: the dtype or the shape [..., 2] is wrong, or a concrete number is no direction.
    """
    actions = integer_array("action", actions)
    if actions.shape != shape:
        raise ValueError(
            f"action must be integer{list(shape)}, (grasp, move) in the last axis, got "
            f"{describe_array(actions)}; action_from_index converts 4 * grasp + move, and jax.vmap "
            "steps several environments"
        )
    if not isinstance(actions, Tracer):
        concrete = np.asarray(actions)
        wrong = concrete[((concrete < 0) | (concrete >= NUM_DIRECTIONS)).any(-1)].tolist()
        if wrong:
            allowed = ", ".join(f"{code} {name}" for code, name in enumerate(DIRECTION_NAMES))
            raise ValueError(f"action {tuple(wrong[0])} is out of range; allowed: {allowed}")
    return jnp.asarray(actions)


def are_known(transfers: Iterable[Transfer]) -> bool:
    """Tests whether transfers are of this package.

    They draw valid states, and keep the colours of agent and food.
    """
    graded = (GradedPerceptual, GradedStructural)
    return all(isinstance(x, graded) or x in _KNOWN for x in parts_of(transfers))


def _timestep(state: State, reward: jax.Array) -> TimeStep:
    # Copies, since the caller may donate the state and keep the timestep.
    return TimeStep(
        observation=observe(state),
        reward=reward,
        terminated=jnp.copy(state.terminated),
        truncated=jnp.copy(state.truncated),
        discount=1.0 - state.terminated.astype(jnp.float32),
    )


def _check_base(base: State) -> State:
    """Returns a copy of `base`, which the caller may donate or change, if it is at time 0."""
    base = validate(with_narrow_integers(base))
    time = int(base.time)
    if time != 0:
        raise ValueError(
            f"the base state is at time {time}; allowed: time 0, as in "
            "base.replace(time=np.int32(0))"
        )
    return jax.tree.map(jnp.array, base)


def _try_transfer(transfer: Transfer, keys: jax.Array, states: State) -> State:
    """Returns the batch of states that a transfer returns, if episodes may start from them."""
    name = transfer_name(transfer)
    try:
        batch = jax.jit(jax.vmap(compose(transfer)))(keys, states)
    except Exception as error:  # whatever a user's function raises
        raise ValueError(
            f"transfer {name} failed; allowed: a function (key, state) -> state that runs under "
            f"jax.jit and jax.vmap; {type(error).__name__}: {error}"
        ) from error
    validate_batch(batch, NUM_TRIALS, f"transfer {name}")
    before, after = (take(x, 0).palette for x in (states, batch))
    if batch.time.any() or before.shape != after.shape:
        raise ValueError(
            f"transfer {name} must keep time 0 and a palette of {describe_array(before)}, got time "
            f"{int(batch.time.max())} and {describe_array(after)}"
        )
    return batch
