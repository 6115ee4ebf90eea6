"""Many environments at once that start over by themselves: the fast path on a CPU.

`VectorEnvironment` does what `jax.vmap` of an `AutoReset` does, bit for bit; that is the
plain reference to read and to test against. Three differences make it fast:

1. Auto-reset by selection draws a new task for every environment at every step. Here the
   finished environments alone start over, gathered into chunks of fixed size, as many
   chunks as it takes.
2. Board and palette are fixed within an episode, so their picture is drawn once, at the
   reset. A step draws food, tool and agent over it.
3. A picture is a flat vector of bytes, each compared with its own row and column. A loop
   over 12 * 12 * N neighbouring bytes vectorises; one whose innermost axis are three
   channels does not. The pictures pass through the loop of the resets, which keeps XLA
   from fusing the later reshape to [12, 12, N] into that loop over bytes.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from trap_tube_jax.checks import check_integer, check_own_state
from trap_tube_jax.environment import Environment
from trap_tube_jax.objects import AGENT, BOARD_SIZE, FOOD, GROUND, STATIC_OBJECTS, TOOL
from trap_tube_jax.state import State, TimeStep
from trap_tube_jax.wrappers import (
    AutoReset,
    AutoResetState,
    AutoResetTimeStep,
    auto_reset_timestep,
)

MAX_SELECTED_FEATURES = 8


class VectorState(struct.PyTreeNode):
    """The states of B environments that start over by themselves.

    Attributes:
      episodes: the states and keys that `jax.vmap` of an `AutoReset` keeps.
      background: u8[B, 12 * 12 * N], each board without food, tool and agent.
    """

    episodes: AutoResetState
    background: jax.Array


class VectorEnvironment:
    """B environments in step, each starting its next episode when one ends.

    States, observations and everything else equal `jax.vmap` of `AutoReset(env)`, for the
    same keys and actions. It is batched already: jit and scan it, and do not vmap it over
    environments. A vmap over seeds works; each step then runs as many chunks as the seed with
    the most finished environments needs.
    """

    starts_over = True

    def __init__(self, env: Environment, *, chunk_size: int = 32):
        """Wraps the environment of one task set.

        Args:
          env: the environment; not wrapped in an `AutoReset`.
          chunk_size: how many environments start over at a time, at least 1. Small
            chunks waste less when few end together, and are quick on a CPU; a GPU wants
            large ones.

        Raises:
          ValueError: naming the argument, its value and what is allowed.
        """
        if not isinstance(env, Environment):
            raise ValueError(f"env must be a trap_tube_jax.Environment, got {type(env).__name__}")
        self.env = env
        self.chunk_size = check_integer("chunk_size", chunk_size)
        self._auto_reset = AutoReset(env)

    def reset(self, keys: jax.Array) -> tuple[VectorState, AutoResetTimeStep]:
        """Starts the first episodes, one for each of the keys [B].

        Raises:
          ValueError: `keys` is not a batch of keys.
        """
        _check_keys(keys)
        episodes, timestep = jax.vmap(self._auto_reset.reset)(keys)
        return VectorState(episodes, jax.vmap(draw_static)(episodes.inner)), timestep

    def step(self, state: VectorState, actions: jax.Array) -> tuple[VectorState, AutoResetTimeStep]:
        """Takes one action i32[B, 2] in each and starts over those whose episode ended.

        Numbers of actions are not checked; see `Environment.step`.

        Raises:
          ValueError: `state` is not what `reset` and `step` return first, or the actions' shape is
            wrong.
        """
        stepped, timestep, final_picture = self._advance(state, actions)
        state, picture = self._start_over(timestep.done, stepped, final_picture)
        return state, auto_reset_timestep(timestep, picture, final_picture)

    def _advance(
        self, state: VectorState, actions: jax.Array
    ) -> tuple[VectorState, TimeStep, jax.Array]:
        """One step without any reset: states, timesteps, and pictures u8[B, 12 * 12 * N]."""
        _check_step(state, actions)
        inner, timestep = jax.vmap(self.env.step)(state.episodes.inner, actions)
        stepped = VectorState(AutoResetState(inner, state.episodes.key), state.background)
        return stepped, timestep, jax.vmap(draw_movable)(inner, state.background)

    def _start_over(
        self, done: jax.Array, state: VectorState, picture: jax.Array
    ) -> tuple[VectorState, jax.Array]:
        """Replaces state and picture where `done` bool[B] by those of a next episode."""
        num_envs, size = len(done), min(self.chunk_size, len(done))
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
            # What is read back from where it was written is not computed again in each of its
            # uses, as XLA does with what it fuses.
            new, _ = jax.vmap(self._auto_reset.reset)(read(state.episodes.key))
            episodes = jax.tree.map(write, state.episodes, new)
            inner = jax.tree.map(read, episodes.inner)
            background = write(state.background, jax.vmap(draw_static)(inner))
            picture = write(picture, jax.vmap(draw_movable)(inner, read(background)))
            return started + size, (VectorState(episodes, background), picture)

        _, (state, picture) = jax.lax.while_loop(
            lambda carry: carry[0] < finished[num_envs - 1],
            start_chunk,
            (jnp.int32(0), (state, picture)),
        )
        return state, picture


def _check_keys(keys: Any) -> None:
    is_typed = jnp.issubdtype(getattr(keys, "dtype", np.int32), jax.dtypes.prng_key)
    if np.ndim(keys) != (1 if is_typed else 2):
        raise ValueError(
            f"reset takes PRNG keys [B], got {type(keys).__name__} of shape {np.shape(keys)}; make "
            "them with jax.random.split(jax.random.key(seed), B)"
        )


def _check_step(state: Any, actions: Any) -> None:
    check_own_state(state, VectorState)
    wanted = (len(state.background), 2)
    if np.shape(actions) != wanted:
        raise ValueError(f"actions must be integer{list(wanted)}, got shape {np.shape(actions)}")


def draw_static(state: State) -> jax.Array:
    """u8[12 * 12 * N]: the features of the board without food, tool and agent."""
    num_features = state.palette.shape[-1]
    objects = jnp.repeat(state.board.reshape(-1), num_features)
    features = _everywhere(state.palette[GROUND])
    for code in STATIC_OBJECTS[1:]:
        features = jnp.where(objects == code, _everywhere(state.palette[code]), features)
    return features


def draw_movable(state: State, background: jax.Array) -> jax.Array:
    """u8[12 * 12 * N]: food, tool and agent over a `draw_static` picture, as `observe` has them.

    Each byte is compared with its own row and column.
    """
    num_features = state.palette.shape[-1]
    cell = np.arange(background.size) // num_features
    row, column = (cell // BOARD_SIZE).astype(np.uint8), (cell % BOARD_SIZE).astype(np.uint8)
    top, left = state.tool.astype(jnp.uint8)
    height, width = state.tool_extent.astype(jnp.uint8)
    # Below the top or left of it, the unsigned difference wraps around to a large number.
    in_tool = (row - top < height) & (column - left < width)

    def at(position: jax.Array) -> jax.Array:
        return (row == position[0].astype(jnp.uint8)) & (column == position[1].astype(jnp.uint8))

    features = jnp.where(at(state.food), _everywhere(state.palette[FOOD]), background)
    features = jnp.where(in_tool, _everywhere(state.palette[TOOL]), features)
    return jnp.where(at(state.agent), _everywhere(state.palette[AGENT]), features)


def _everywhere(features: jax.Array) -> jax.Array:
    """u8[12 * 12 * N]: the features u8[N] of one object in every cell."""
    (num_features,) = features.shape
    if num_features > MAX_SELECTED_FEATURES:
        return jnp.tile(features, BOARD_SIZE**2)
    # Selects by constant masks vectorise on a CPU; the gather in a tile does not.
    channel = np.arange(BOARD_SIZE**2 * num_features) % num_features
    picture = jnp.broadcast_to(features[0], channel.shape)
    for index in range(1, num_features):
        picture = jnp.where(channel == index, features[index], picture)
    return picture
