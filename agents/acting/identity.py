"""Which observations are the same, told by a few integers instead of by their pixels."""

import jax
import jax.numpy as jnp

from agents.acting.episodes import Episodes, place
from agents.networks.grouping import group, group_rows, hash_rows
from trap_tube_jax.positions import position_id
from trap_tube_jax.state import State


def layout_ids(layout: State) -> jax.Array:
    """An id i32[B] for each of B states, equal only for equal boards, palettes, tool extents."""
    return group_rows(_layout_content(layout)).number


def layout_hashes(layout: State) -> jax.Array:
    """A hash u32[B] of the boards, palettes and tool extents of B states."""
    return hash_rows(_layout_content(layout))


def position_ids(episodes: Episodes) -> jax.Array:
    """i32[T + 1, B]: `position_id` at every observation."""
    states = jax.vmap(jax.vmap(place), in_axes=(None, 0))(episodes.layout, episodes.cells)
    return jax.vmap(jax.vmap(position_id))(states)


def observation_ids(episodes: Episodes) -> jax.Array:
    """i32[T + 1, B]: equal only for equal observations, numbered from 0."""
    position = position_ids(episodes)
    layout = jnp.broadcast_to(layout_ids(episodes.layout), position.shape)
    return group(layout.reshape(-1), position.reshape(-1)).number.reshape(position.shape)


def visits(observation_id: jax.Array) -> jax.Array:
    """f32[T + 1, B]: how often its episode has seen an observation so far, this time included."""
    time = jnp.arange(len(observation_id))
    same = observation_id[:, None] == observation_id[None]
    so_far = (time[:, None] >= time[None])[..., None]
    return jnp.sum(same & so_far, axis=1, dtype=jnp.float32)


def first_visits(observation_id: jax.Array) -> jax.Array:
    """f32[T + 1, B]: 1 where an observation is new in its episode, 0 where it returns."""
    return (visits(observation_id) == 1).astype(jnp.float32)


def _layout_content(layout: State) -> jax.Array:
    """u8[B, K]: board, palette and tool extent of each state as one row."""
    parts = (layout.board, layout.palette, layout.tool_extent.astype(jnp.uint8))
    return jnp.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)
