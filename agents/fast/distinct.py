"""Encodes each distinct observation once.

Episodes meet the same observations again and again: an agent that walks into a wall sees nothing
new. `Cache` encodes observations while episodes are played, and reuses the features of observations
that any episode has met before. `FastEncoding.encode_episodes` encodes the distinct observations of
finished episodes.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

import trap_tube_jax as tt
from agents.acting.encoding import Encoding
from agents.acting.episodes import Episodes, with_cells
from agents.fast import chunks, windows
from agents.fast.convolution import convolutions_as_products
from agents.fast.grouping import group, group_rows, slots
from agents.networks.agent import Params
from agents.networks.encoder import Encoder
from trap_tube_jax.positions import layout_rows, position_id
from trap_tube_jax.state import take

CACHE_BITS = 20  # hash bits; `Cache` has a slot for each value
CONVOLVING_CHUNK = 64  # observations that a convolving encoder gets at once
CHUNK = 256  # observations that another encoder gets at once


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


class FastEncoding(Encoding):
    """Encodes each distinct observation once, chunk by chunk; see `Encoding`."""

    name = "fast"

    @property
    def chunk(self) -> int:
        """Observations encoded at once."""
        return CONVOLVING_CHUNK if self._has_windows else CHUNK

    @property
    def _has_windows(self) -> bool:
        return type(self.agent.encoder) is Encoder  # a subclass may compute something else

    def start(self, params: Params, initial: tt.State, num_steps: int) -> Cache:
        """Returns an empty cache for B episodes of `num_steps` steps."""
        boards = jax.eval_shape(jax.vmap(tt.observe), initial)
        batch, width = jax.eval_shape(self.agent.encode, params, boards).shape
        return Cache(
            layout_id=group_rows(layout_rows(initial)).group_id,
            position=jnp.zeros((num_steps + 1, batch), jnp.int32),
            features=jnp.zeros((num_steps + 1, batch, width), jnp.float32),
            newest=jnp.full(2**CACHE_BITS, -1, jnp.int32),
        )

    def step(
        self, params: Params, state: tt.State, time: jax.Array, memory: Cache
    ) -> tuple[jax.Array, Cache]:
        """Returns the features f32[B, F] of B states' observations at `time`, and the cache."""
        batch, width = memory.features.shape[1:]
        position = jax.vmap(position_id)(state)
        slot = slots(jnp.stack([memory.layout_id, position], axis=1), CACHE_BITS)
        met = memory.newest[slot]
        is_known = (
            (met >= 0)
            & (memory.layout_id[met % batch] == memory.layout_id)
            & (memory.position.reshape(-1)[met] == position)
        )
        # False sorts before true: the distinct unknown observations come first.
        groups = group(is_known.astype(jnp.int32), memory.layout_id, position)
        num_new = jnp.max(jnp.where(is_known, -1, groups.group_id)) + 1
        rows = jax.vmap(tt.observe)(take(state, groups.representative))
        new: Any = chunks.map_rows(self._encode_policy_rows, self.chunk, params, rows, num_new)
        known = memory.features.reshape(-1, width)[met]
        features = jnp.where(is_known[:, None], known, new[groups.group_id])
        index = time * batch + jnp.arange(batch, dtype=jnp.int32)
        return features, memory._replace(
            position=memory.position.at[time].set(position),
            features=memory.features.at[time].set(features),
            newest=memory.newest.at[slot].max(index),
        )

    def encode_episodes(self, params: Params, episodes: Episodes) -> tuple[jax.Array, jax.Array]:
        """Encodes all observations of episodes; see `Encoding`."""
        position = episodes.position_ids()
        layout_id = group_rows(layout_rows(episodes.layout)).group_id
        layout_id = jnp.broadcast_to(layout_id[:, None], position.shape)
        groups = group(layout_id.reshape(-1), position.reshape(-1))
        episode, time = jnp.divmod(groups.representative, position.shape[1])
        layout = take(episodes.layout, episode)
        states = jax.vmap(with_cells)(layout, episodes.cells[episode, time])
        rows = jax.vmap(tt.observe)(states)
        read = {name: params[name] for name in ("encoder", "curiosity")}
        features = chunks.map_rows(self._encode_rows, self.chunk, read, rows, groups.total)
        group_id = groups.group_id.reshape(position.shape)
        return jax.tree.map(lambda x: x[group_id], features)

    def _encode_rows(self, params: Params, rows: jax.Array, remembered: Any) -> Any:
        """Encodes rows for policy and curiosity; see `chunks.map_rows`."""
        features, remembered = self._encode_policy_rows(params, rows, remembered)
        with convolutions_as_products():
            curious = self.encode_for_curiosity(params["curiosity"], rows)
        return (features, curious), remembered

    def _encode_policy_rows(self, params: Params, rows: jax.Array, remembered: Any) -> Any:
        """Encodes rows for the policy; see `chunks.map_rows`."""
        if self._has_windows:
            return windows.encode_rows(params["encoder"], rows, remembered)
        with convolutions_as_products():
            return self.agent.encode(params, rows), None
