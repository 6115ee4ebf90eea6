"""Batches of environments with auto-reset: the fast path on a CPU.

`VectorEnvironment` equals `jax.vmap` of an `AutoReset`; read that first. Three differences make it
fast:

1. Auto-reset by selection draws a new task for every environment at every step. Here only
   finished environments start over, in as many chunks of fixed size as needed.
2. Board and palette are fixed within an episode, so their picture is drawn once, at the
   reset. A step draws food, tool and agent over it.
3. A picture is a flat vector of bytes, compared with vectors of their rows and columns. A loop over
   12 * 12 * N neighbouring bytes vectorises; a loop whose innermost axis has three channels
   does not. The pictures pass through the loop of the resets, which keeps XLA from fusing the
   later reshape to [12, 12, N] into the loop over bytes.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from trap_tube_jax.by_value import ByValue
from trap_tube_jax.checks import check_own_state, describe_array
from trap_tube_jax.environment import Environment, check_actions
from trap_tube_jax.objects import AGENT, BOARD_SIZE, FOOD, GROUND, STATIC_OBJECTS, TOOL
from trap_tube_jax.prng import raw_shape
from trap_tube_jax.state import State, TimeStep
from trap_tube_jax.wrappers import (
    AutoReset,
    AutoResetState,
    AutoResetTimeStep,
    auto_reset_timestep,
)

MAX_SELECTED_FEATURES = 8
MIN_CHUNK = 32  # environments that start over at a time


class VectorState(ByValue, struct.PyTreeNode, eq=False):
    """The states of B environments with auto-reset.

    Attributes:
      episodes: states and keys, as `jax.vmap` of an `AutoReset` keeps them.
      background: u8[B, 12 * 12 * N], the boards without food, tool and agent. Replace it together
        with `episodes.inner`, by `jax.vmap(trap_tube_jax.vector.draw_static)(inner)`.

    Example:
      >>> env = tt.VectorEnvironment(tt.make("base"))
      >>> state, timestep = env.reset(jax.random.split(jax.random.key(0), 64))
      >>> state.episodes.inner.agent.shape  # the positions of 64 agents
      (64, 2)
    """

    episodes: AutoResetState
    background: jax.Array


@dataclasses.dataclass(frozen=True)
class VectorEnvironment:
    """B environments in lockstep, which start the next episode where one ends.

    States, observations and everything else equal `jax.vmap` of `AutoReset(env)` for the same
    keys and actions, up to the rounding of colours between programs (`Environment.reset`).

    The environment is batched: jit and scan it, and do not vmap it over environments. A vmap over
    seeds works; a step then runs as many chunks as the seed with the most finished environments
    needs.

    Attributes:
      env: an environment without auto-reset, not a subclass: the batch would bypass its methods.

    Raises:
      ValueError: `env` is something else.

    Example:
      >>> env = tt.VectorEnvironment(tt.make("base"))
      >>> state, timestep = env.reset(jax.random.split(jax.random.key(0), 64))
      >>> state, timestep = jax.jit(env.step)(state, jnp.zeros((64, 2), jnp.int32))
      >>> timestep.observation.shape, timestep.final_observation.shape
      ((64, 12, 12, 3), (64, 12, 12, 3))
    """

    env: Environment

    def __post_init__(self):
        if type(self.env) is not Environment:
            hint = "; jax.vmap(AutoReset(env).step) steps a subclass"
            raise ValueError(
                f"env must be a trap_tube_jax.Environment, got {self.env!r}"
                + (hint if isinstance(self.env, Environment) else "")
            )

    def reset(self, keys: jax.Array) -> tuple[VectorState, AutoResetTimeStep]:
        """Starts the first episodes, one for each of the keys [B], B >= 1.

        Raises:
          ValueError: `keys` is not a batch of PRNG keys.
        """
        _check_keys(keys)
        episodes, timestep = jax.vmap(AutoReset(self.env).reset)(keys)
        return VectorState(episodes, jax.vmap(draw_static)(episodes.inner)), timestep

    def step(self, state: VectorState, actions: jax.Array) -> tuple[VectorState, AutoResetTimeStep]:
        """Takes one action in every environment and starts the next episode where one ended.

        Args:
          state: the state that `reset` or `step` returned.
          actions: integer[B, 2]; see `Environment.step`.

        Raises:
          ValueError: `state` is of another type, or the actions' shape, dtype or concrete
            numbers are wrong.
        """
        stepped, timestep, final_picture = self._advance(state, actions)
        state, picture = self._reset_done(timestep.done, stepped, final_picture)
        return state, auto_reset_timestep(timestep, picture, final_picture)

    def _advance(
        self, state: VectorState, actions: jax.Array
    ) -> tuple[VectorState, TimeStep, jax.Array]:
        """Takes one step without any reset; also returns pictures u8[B, 12 * 12 * N]."""
        check_own_state(state, VectorState)
        actions = check_actions(actions, (len(state.background), 2))
        inner, timestep = jax.vmap(self.env.step)(state.episodes.inner, actions)
        stepped = VectorState(AutoResetState(inner, state.episodes.key), state.background)
        return stepped, timestep, jax.vmap(draw_movable)(inner, state.background)

    def _reset_done(
        self, done: jax.Array, state: VectorState, picture: jax.Array
    ) -> tuple[VectorState, jax.Array]:
        """Starts the next episode where `done` bool[B], in the state and in the picture."""
        num_envs = len(done)
        size = _chunk_size(num_envs)
        finished = jnp.cumsum(done, dtype=jnp.int32)

        def start_chunk(carry):
            started, (state, picture) = carry
            # The environment at which the count of finished ones reaches its next value;
            # past the last one that is `num_envs`, where writes are dropped.
            ranks = started + 1 + jnp.arange(size, dtype=jnp.int32)
            index = jnp.searchsorted(finished, ranks, method="scan_unrolled")
            read = lambda rows: rows.at[index].get(mode="clip")  # noqa: E731
            write = lambda into, rows: into.at[index].set(  # noqa: E731
                rows, mode="drop", indices_are_sorted=True
            )
            # Reading back what was just written keeps XLA from computing it again at every use.
            keys = jax.random.clone(read(state.episodes.key))  # overwritten by the next ones
            new, _ = jax.vmap(AutoReset(self.env).reset)(keys)
            episodes = jax.tree.map(write, state.episodes, new)
            inner = jax.tree.map(read, episodes.inner)
            background = write(state.background, jax.vmap(draw_static)(inner))
            picture = write(picture, jax.vmap(draw_movable)(inner, read(background)))
            return started + size, (VectorState(episodes, background), picture)

        _, (state, picture) = jax.lax.while_loop(
            lambda carry: carry[0] < finished[-1],
            start_chunk,
            (jnp.int32(0), (state, picture)),
        )
        return state, picture


def _chunk_size(num_envs: int) -> int:
    """Returns how many environments start over at a time.

    Small chunks waste less when few episodes end together; large ones occupy a GPU.
    """
    size = MIN_CHUNK if jax.default_backend() == "cpu" else max(MIN_CHUNK, num_envs // 32)
    return min(size, num_envs)


def _check_keys(keys: Any) -> None:
    found = type(keys).__name__
    if isinstance(keys, jax.Array | np.ndarray):
        is_typed = jnp.issubdtype(keys.dtype, jax.dtypes.prng_key)
        is_raw = keys.dtype == np.uint32 and keys.shape[1:] == raw_shape()
        if keys.ndim and len(keys) and (keys.ndim == 1 if is_typed else is_raw):
            return
        found = describe_array(keys)
    raise ValueError(
        f"expected an array of PRNG keys [B] with B >= 1, got {found}; make them with "
        "jax.random.split(jax.random.key(seed), B)"
    )


def draw_static(state: State) -> jax.Array:
    """Draws the board without food, tool and agent, u8[12 * 12 * N]."""
    num_features = state.palette.shape[-1]
    objects = jnp.repeat(state.board.reshape(-1), num_features)
    features = _everywhere(state.palette[GROUND])
    for code in STATIC_OBJECTS[1:]:
        features = jnp.where(objects == code, _everywhere(state.palette[code]), features)
    return features


def draw_movable(state: State, background: jax.Array) -> jax.Array:
    """Draws food, tool and agent over a `draw_static` picture: a flat `observe`."""
    num_features = state.palette.shape[-1]
    cell = np.arange(background.size) // num_features
    row = (cell // BOARD_SIZE).astype(np.uint8)
    column = (cell % BOARD_SIZE).astype(np.uint8)
    top, left = state.tool.astype(jnp.uint8)
    height, width = state.tool_extent.astype(jnp.uint8)
    # Above or left of the tool the unsigned difference wraps around to a large number.
    in_tool = (row - top < height) & (column - left < width)

    def at(position: jax.Array) -> jax.Array:
        return (row == position[0].astype(jnp.uint8)) & (column == position[1].astype(jnp.uint8))

    features = jnp.where(at(state.food), _everywhere(state.palette[FOOD]), background)
    features = jnp.where(in_tool, _everywhere(state.palette[TOOL]), features)
    return jnp.where(at(state.agent), _everywhere(state.palette[AGENT]), features)


def _everywhere(features: jax.Array) -> jax.Array:
    """Repeats the features u8[N] of one object in every cell, u8[12 * 12 * N]."""
    (num_features,) = features.shape
    if num_features > MAX_SELECTED_FEATURES:
        return jnp.tile(features, BOARD_SIZE**2)
    # Selects by constant masks vectorise on a CPU; the gather in a tile does not.
    channel = np.arange(BOARD_SIZE**2 * num_features) % num_features
    picture = jnp.broadcast_to(features[0], channel.shape)
    for index in range(1, num_features):
        picture = jnp.where(channel == index, features[index], picture)
    return picture
