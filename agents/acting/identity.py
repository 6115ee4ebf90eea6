"""Integers that are equal only for equal layouts or observations."""

import jax
import jax.numpy as jnp

from agents.acting.episodes import Episodes, place
from agents.networks.grouping import group, group_rows, hash_rows
from trap_tube_jax.positions import position_id
from trap_tube_jax.state import State


def layout_ids(layout: State) -> jax.Array:
    """Returns an id i32[B] of each state's board, palette and tool extent."""
    return group_rows(_layout_content(layout)).number


def layout_hashes(layout: State) -> jax.Array:
    """Returns a hash u32[B] of each state's board, palette and tool extent."""
    return hash_rows(_layout_content(layout))


def position_ids(episodes: Episodes) -> jax.Array:
    """Returns the `position_id` i32[T + 1, B] of every observation."""
    states = jax.vmap(jax.vmap(place), in_axes=(None, 0))(episodes.layout, episodes.cells)
    return jax.vmap(jax.vmap(position_id))(states)


def observation_ids(episodes: Episodes) -> jax.Array:
    """Returns an id i32[T + 1, B] of every observation, counted from 0."""
    position = position_ids(episodes)
    layout = jnp.broadcast_to(layout_ids(episodes.layout), position.shape)
    return group(layout.reshape(-1), position.reshape(-1)).number.reshape(position.shape)


def visits(observation_id: jax.Array) -> jax.Array:
    """Counts each observation's visits by its episode so far, f32[T + 1, B], this one included."""
    time = jnp.arange(len(observation_id), dtype=jnp.int32)
    same = observation_id[:, None] == observation_id[None]
    so_far = (time[:, None] >= time[None])[..., None]
    return jnp.sum(same & so_far, axis=1, dtype=jnp.float32)


def first_visits(observation_id: jax.Array) -> jax.Array:
    """Returns f32[T + 1, B], 1 where an observation is new in its episode, else 0."""
    return (visits(observation_id) == 1).astype(jnp.float32)


def _layout_content(layout: State) -> jax.Array:
    parts = (layout.board, layout.palette, layout.tool_extent.astype(jnp.uint8))
    return jnp.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)
