"""The environment: a pure `reset` and a pure `step` over one task.

Source: paper, section "Environments"; environment.md.
"""

import dataclasses
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from trap_tube_jax import dynamics
from trap_tube_jax.checks import check_integer
from trap_tube_jax.objects import (
    BOARD_SIZE,
    DIRECTION_NAMES,
    MAX_STEPS,
    NO_DIRECTION,
    NUM_ACTIONS,
    NUM_DIRECTIONS,
)
from trap_tube_jax.observation import observe
from trap_tube_jax.state import State, TimeStep, base_state, check_state, check_structure, validate
from trap_tube_jax.transfers import Transfer, compose, perceptual, structural, symbolic

LARGEST_TIME = 2**31 - 1  # `State.time` is an i32

_TRUSTED_TRANSFERS = (perceptual, structural, symbolic)


@dataclasses.dataclass(frozen=True)
class ArraySpec:
    """Shape, dtype and inclusive bounds of an array.

    Attributes:
      shape: its dimensions.
      dtype: its NumPy dtype.
      minimum: the smallest allowed element.
      maximum: the largest allowed element.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    minimum: int
    maximum: int


class Environment:
    """A distribution over tasks: a base state under a sequence of transfers.

    `reset` and `step` are pure and unbatched: jit, vmap and scan them. An environment
    holds no episode; everything that changes is in the `State`.
    """

    def __init__(
        self,
        transfers: Iterable[Transfer] = (),
        *,
        base: State | None = None,
        max_steps: int = MAX_STEPS,
    ):
        """Checks its arguments.

        Transfers of your own are tried once, with one key, each on the state that those before
        it return.

        Args:
          transfers: functions (key, state) -> state, applied in order at every reset, each
            with a typed key of its own (`compose`).
          base: the state that the transfers start from, at time 0; the base task if absent.
          max_steps: steps after which an unsolved episode is truncated, 1 to 2**31 - 1.

        Raises:
          ValueError: naming the argument, its value and what is allowed.
        """
        if callable(transfers) or not isinstance(transfers, Iterable):
            raise ValueError(
                f"transfers must be a sequence of functions (key, state) -> state, "
                f"got {transfers!r}"
            )
        self.max_steps = check_integer("max_steps", max_steps, maximum=LARGEST_TIME)
        self.transfers = tuple(transfers)
        self.base = base_state() if base is None else _check_base(base)
        self._transfer = compose(*self.transfers)
        self._check_transfers()

    def reset(self, key: jax.Array) -> tuple[State, TimeStep]:
        """Draws a task.

        Args:
          key: PRNG key; the same key gives the same task, bit for bit.

        Returns:
          The state at time 0, and a timestep with reward 0.

        Raises:
          ValueError: `key` is not one PRNG key.
        """
        state = self._transfer(_typed_key(key), self.base)
        return state, _timestep(state, reward=jnp.zeros((), jnp.float32))

    def step(self, state: State, action: jax.Array) -> tuple[State, TimeStep]:
        """Takes one action. Deterministic; a done state stays, with reward 0.

        Args:
          state: one unbatched state.
          action: integer[2] = (grasp, move), each 0 up, 1 down, 2 left, 3 right. Under jit,
            vmap and scan the numbers are not checked: any other one is no direction.

        Returns:
          The next state, and a timestep with reward 1 if this step solved the task.

        Raises:
          ValueError: `state` is not one unbatched state; the action's shape or dtype is wrong, or
            its concrete numbers.
        """
        check_state(state)
        action = _check_action(action)
        was_done = state.terminated | state.truncated
        state = dynamics.step(state, action)
        time = state.time + ~was_done
        truncated = state.truncated | (~state.terminated & (time >= self.max_steps))
        state = state.replace(time=time, truncated=truncated)
        reward = (state.terminated & ~was_done).astype(jnp.float32)
        return state, _timestep(state, reward)

    @property
    def num_features(self) -> int:
        """N, the feature channels of the observation."""
        return self.base.palette.shape[-1]

    @property
    def num_actions(self) -> int:
        """16, the number of (grasp, move) pairs."""
        return NUM_ACTIONS

    @property
    def observation_spec(self) -> ArraySpec:
        """The observation: u8[12, 12, N] in 0 to 255."""
        return ArraySpec((BOARD_SIZE, BOARD_SIZE, self.num_features), np.dtype(np.uint8), 0, 255)

    @property
    def action_spec(self) -> ArraySpec:
        """The action: i32[2] = (grasp, move) in 0 to 3."""
        return ArraySpec((2,), np.dtype(np.int32), 0, NUM_DIRECTIONS - 1)

    def __repr__(self) -> str:
        names = ", ".join(getattr(transfer, "__name__", "?") for transfer in self.transfers)
        return f"Environment(transfers=({names}), max_steps={self.max_steps})"

    def _check_transfers(self) -> None:
        state, key = self.base, jax.random.key(0)
        last = max(
            (i for i, each in enumerate(self.transfers) if each not in _TRUSTED_TRANSFERS),
            default=-1,
        )
        for transfer in self.transfers[: last + 1]:
            if transfer in _TRUSTED_TRANSFERS:
                state = jax.jit(transfer)(key, state)
            else:
                state = _try_transfer(transfer, key, state)


def action_from_index(index: jax.Array) -> jax.Array:
    """The action i32[..., 2] = (grasp, move) of an integer[...] `4 * grasp + move` in 0 to 15.

    Any other number becomes (-1, -1), which are no directions.

    Raises:
      ValueError: `index` does not hold integers.
    """
    index = jnp.asarray(index)
    if not jnp.issubdtype(index.dtype, jnp.integer):
        raise ValueError(f"an action's index must be an integer, got {index.dtype}")
    action = jnp.stack([index // NUM_DIRECTIONS, index % NUM_DIRECTIONS], -1).astype(jnp.int32)
    is_known = (index >= 0) & (index < NUM_ACTIONS)
    return jnp.where(is_known[..., None], action, NO_DIRECTION)


def action_to_index(action: jax.Array) -> jax.Array:
    """The integer i32[...] `4 * grasp + move` of an action integer[..., 2]."""
    action = jnp.asarray(action)
    return (action[..., 0] * NUM_DIRECTIONS + action[..., 1]).astype(jnp.int32)


def _timestep(state: State, reward: jax.Array) -> TimeStep:
    return TimeStep(
        observation=observe(state),
        reward=reward,
        terminated=state.terminated,
        truncated=state.truncated,
        discount=1.0 - state.terminated.astype(jnp.float32),
    )


def check_key(key: Any) -> jax.Array:
    """Returns `key` if it is one PRNG key, typed or u32[2].

    Raises:
      ValueError: it is not.
    """
    is_typed = isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    is_raw = getattr(key, "dtype", None) == jnp.uint32 and np.shape(key) == (2,)
    if not is_raw and not (is_typed and key.shape == ()):
        raise ValueError(
            f"reset takes one PRNG key, got {type(key).__name__} of shape {np.shape(key)}; "
            "make one with jax.random.key(seed), and jax.vmap over several"
        )
    return key


def _typed_key(key: Any) -> jax.Array:
    """One PRNG key as a typed one: transfers get this type, whatever `reset` was given."""
    key = check_key(key)
    return jax.random.wrap_key_data(key) if key.dtype == jnp.uint32 else key


def _check_action(action: Any) -> jax.Array:
    action = jnp.asarray(action)
    if action.shape != (2,) or not jnp.issubdtype(action.dtype, jnp.integer):
        raise ValueError(
            f"an action is integer[2] = (grasp, move), got {action.dtype}{list(action.shape)}; "
            "action_from_index converts 4 * grasp + move, and jax.vmap steps several"
        )
    if not isinstance(action, Tracer):
        grasp, move = np.asarray(action).tolist()
        if not (0 <= grasp < NUM_DIRECTIONS and 0 <= move < NUM_DIRECTIONS):
            allowed = ", ".join(f"{code} {name}" for code, name in enumerate(DIRECTION_NAMES))
            raise ValueError(f"action ({grasp}, {move}) is out of range; allowed: {allowed}")
    return action.astype(jnp.int32)


def _check_base(base: State) -> State:
    """Returns `base` if an episode can start from it."""
    validate(base)
    time = int(base.time)
    if time != 0:
        raise ValueError(
            f"the base state is at time {time}; allowed: time 0, as in "
            "base.replace(time=np.int32(0))"
        )
    return base


def _try_transfer(transfer: Transfer, key: jax.Array, state: State) -> State:
    """The state that a transfer returns, which must be a valid one."""
    name = getattr(transfer, "__name__", repr(transfer))
    try:
        structure = jax.eval_shape(transfer, key, state)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"transfer {name} failed; allowed: a function (key, state) -> state that runs under "
            f"jax.jit; {type(error).__name__}: {error}"
        ) from error
    try:
        check_structure(structure)
        return validate(jax.jit(transfer)(key, state))
    except ValueError as error:
        raise ValueError(f"transfer {name} returned a broken state: {error}") from error
