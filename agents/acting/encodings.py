"""Fast path: features of all observations of episodes, each distinct observation encoded once.

`Cache` encodes observations while episodes are played, and reuses the features of observations that
any episode has met before. `encode_episodes` encodes finished episodes.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from agents.acting.episodes import Episodes, place
from agents.networks import chunks
from agents.networks.agent import Agent, Params
from agents.networks.grouping import group, group_rows, slots
from trap_tube_jax.observation import observe
from trap_tube_jax.positions import position_id
from trap_tube_jax.state import State

CACHE_BITS = 20  # hash bits; `Cache` has a slot for each value


def encode_episodes(
    encode_rows: chunks.RowFn, params: Any, episodes: Episodes, *, chunk: int
) -> Any:
    """Encodes all observations to f32[T + 1, B, F], or to a tree of such arrays.

    The features are differentiable by `params`. `encode_rows` gets `chunk` distinct observations
    u8[chunk, 12, 12, N] at once; see `chunks.map_rows`.
    """
    shape = episodes.observation_id.shape
    groups = group(episodes.observation_id.reshape(-1))
    time, episode = groups.representative // shape[1], groups.representative % shape[1]
    rows = jax.vmap(lambda layout, cells: observe(place(layout, cells)))(
        jax.tree.map(lambda x: x[episode], episodes.layout), episodes.cells[time, episode]
    )
    features = chunks.map_rows(encode_rows, chunk, params, rows, groups.total)
    return jax.tree.map(lambda x: x[groups.number].reshape(*shape, *x.shape[1:]), features)


class Cache(NamedTuple):
    """Features of all observations that B episodes have met so far.

    Attributes:
      layout_id: i32[B], equal only for equal layouts.
      position: i32[T + 1, B], see `position_id`.
      features: f32[T + 1, B, F].
      newest: i32[S], by hash: the flat index time * B + episode at which an observation of this
        hash was last met; -1 for none.
    """

    layout_id: jax.Array
    position: jax.Array
    features: jax.Array
    newest: jax.Array

    @staticmethod
    def empty(agent: Agent, params: Params, initial: State, num_steps: int) -> "Cache":
        """Makes a cache for an episode of `num_steps` steps from each of B initial states."""
        boards = jax.eval_shape(jax.vmap(observe), initial)
        batch, width = jax.eval_shape(agent.encode, params, boards).shape
        return Cache(
            layout_id=group_rows(layout_content(initial)).number,
            position=jnp.zeros((num_steps + 1, batch), jnp.int32),
            features=jnp.zeros((num_steps + 1, batch, width), jnp.float32),
            newest=jnp.full(2**CACHE_BITS, -1, jnp.int32),
        )

    def encode(
        self, agent: Agent, params: Params, state: State, time: jax.Array
    ) -> tuple[jax.Array, "Cache"]:
        """Returns the features f32[B, F] of B states' observations at `time`, and the next cache.

        Encodes at most `encode_chunk_size` observations at once.
        """
        batch, width = self.features.shape[1:]
        position = jax.vmap(position_id)(state)
        slot = slots(jnp.stack([self.layout_id, position], axis=1), CACHE_BITS)
        met = self.newest[slot]
        is_known = (
            (met >= 0)
            & (self.layout_id[met % batch] == self.layout_id)
            & (self.position.reshape(-1)[met] == position)
        )
        # False sorts before true: the distinct unknown observations come first.
        groups = group(is_known.astype(jnp.int32), self.layout_id, position)
        num_new = jnp.max(jnp.where(is_known, -1, groups.number)) + 1
        rows = jax.vmap(observe)(state)[groups.representative]
        new: Any = chunks.map_rows(
            agent.encode_rows, agent.config.encode_chunk_size, params, rows, num_new
        )
        known = self.features.reshape(-1, width)[met]
        features = jnp.where(is_known[:, None], known, new[groups.number])
        index = time * batch + jnp.arange(batch, dtype=jnp.int32)
        return features, self._replace(
            position=self.position.at[time].set(position),
            features=self.features.at[time].set(features),
            newest=self.newest.at[slot].max(index),
        )

    def observation_id(self) -> jax.Array:
        """Returns i32[T + 1, B], equal only for equal observations, counted from 0."""
        layout_id = jnp.broadcast_to(self.layout_id, self.position.shape)
        groups = group(layout_id.reshape(-1), self.position.reshape(-1))
        return groups.number.reshape(self.position.shape)


def layout_content(layout: State) -> jax.Array:
    """Returns rows u8[B, K], equal only for equal boards, palettes and tool extents."""
    parts = (layout.board, layout.palette, layout.tool_extent.astype(jnp.uint8))
    return jnp.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)
