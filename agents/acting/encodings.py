"""Fast path: features of all observations of episodes, each distinct observation encoded once.

`encode_episodes` encodes episodes that have been played. `Cache` encodes observations while
episodes are played, and finds those that any of them has met before.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from agents.acting.episodes import Episodes, place
from agents.networks import chunks
from agents.networks.agent import Agent, Params
from agents.networks.grouping import group, slots
from trap_tube_jax.observation import observe
from trap_tube_jax.positions import position_id
from trap_tube_jax.state import State

CACHE_BITS = 20  # of an observation's hash, in the table of `Cache`


def encode_episodes(
    encode_rows: chunks.RowFn,
    params: Any,
    episodes: Episodes,
    observation_id: jax.Array,
    *,
    chunk: int,
) -> Any:
    """Encodes all observations to f32[T + 1, B, F], or to a tree of such arrays.

    Args:
      encode_rows: encodes observations u8[chunk, 12, 12, N]; see `chunks.map_rows`.
      params: parameters of `encode_rows`, by which the features are differentiable.
      episodes: the episodes.
      observation_id: i32[T + 1, B], equal only for equal observations.
      chunk: distinct observations encoded at once.
    """
    shape = observation_id.shape
    groups = group(observation_id.reshape(-1))
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
    def empty(layout_id: jax.Array, num_steps: int, width: int) -> "Cache":
        """Makes a cache for episodes of `num_steps` steps and features of this width."""
        shape = (num_steps + 1, len(layout_id))
        return Cache(
            layout_id=layout_id,
            position=jnp.zeros(shape, jnp.int32),
            features=jnp.zeros((*shape, width), jnp.float32),
            newest=jnp.full(2**CACHE_BITS, -1, jnp.int32),
        )

    def encode(
        self, agent: Agent, params: Params, state: State, time: jax.Array
    ) -> tuple[jax.Array, "Cache"]:
        """Returns the features f32[B, F] of B states' observations at `time`, and the next cache.

        Encodes at most `encode_chunk_size` observations at once.
        """
        position = jax.vmap(position_id)(state)
        slot = slots(jnp.stack([self.layout_id, position], axis=1), CACHE_BITS)
        is_known, known = self._look_up(position, slot)
        # False sorts before true: the distinct unknown observations come first.
        groups = group(is_known.astype(jnp.int32), self.layout_id, position)
        num_new = jnp.max(jnp.where(is_known, -1, groups.number)) + 1
        rows = jax.vmap(observe)(state)[groups.representative]
        new: Any = chunks.map_rows(
            agent.encode_rows, agent.config.encode_chunk_size, params, rows, num_new
        )
        features = jnp.where(is_known[:, None], known, new[groups.number])
        batch = len(self.layout_id)
        index = time * batch + jnp.arange(batch, dtype=jnp.int32)
        return features, self._replace(
            position=self.position.at[time].set(position),
            features=self.features.at[time].set(features),
            newest=self.newest.at[slot].max(index),
        )

    def _look_up(self, position: jax.Array, slot: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns which observations are known, bool[B], and their features f32[B, F]."""
        met = self.newest[slot]
        same_layout = self.layout_id[met % len(self.layout_id)] == self.layout_id
        same_position = self.position.reshape(-1)[met] == position
        features = self.features.reshape(-1, self.features.shape[-1])[met]
        return (met >= 0) & same_layout & same_position, features
