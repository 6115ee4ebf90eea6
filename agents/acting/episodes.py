"""The record of episodes that acting and learning share."""

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from trap_tube_jax.observation import observe
from trap_tube_jax.state import State

Record = TypeVar("Record")

CELL_AGENT, CELL_TOOL, CELL_FOOD = 0, 1, 2  # places in `Episodes.cells`


class Episodes(NamedTuple):
    """B episodes of T steps; after an early end, the last state repeats.

    Step t leads from observation t to observation t + 1.

    Attributes:
      layout: B states, whose board, palette and tool extent hold for the episode.
      cells: u8[T + 1, B, 3, 2], (row, column) of agent, tool and food at each observation; see
        `CELL_AGENT`, `CELL_TOOL` and `CELL_FOOD`.
      action: i32[T, B, 2], (grasp, move).
      reward: f32[T, B], extrinsic.
      discount: f32[T, B], 0 on the step that terminated the episode and after it, else 1.
      mask: f32[T, B], 1 on steps taken before the episode's end, else 0.
      observation_id: i32[T + 1, B], equal only for equal observations, counted from 0.
    """

    layout: State
    cells: jax.Array
    action: jax.Array
    reward: jax.Array
    discount: jax.Array
    mask: jax.Array
    observation_id: jax.Array

    @property
    def solved(self) -> jax.Array:
        """bool[B], episodes with a reward."""
        return jnp.any(self.reward > 0, axis=0)

    @property
    def length(self) -> jax.Array:
        """i32[B], steps taken."""
        return jnp.sum(self.mask, axis=0).astype(jnp.int32)

    def observations(self) -> jax.Array:
        """Returns all boards, u8[T + 1, B, 12, 12, N]."""
        one_time = jax.vmap(lambda layout, cells: observe(place(layout, cells)))
        return jax.vmap(one_time, in_axes=(None, 0))(self.layout, self.cells)


def take(record: Record, places: jax.Array) -> Record:
    """Returns the episodes at `places` i32[M] of a tree of `Episodes` and arrays [T, B, ...]."""
    layout = jax.tree_util.GetAttrKey("layout")  # arrays [B, ...]
    return jax.tree.map_with_path(
        lambda path, x: x[places] if layout in path else x[:, places], record
    )


def place(layout: State, cells: jax.Array) -> State:
    """Returns the layout with agent, tool and food at `cells` u8[3, 2]."""
    agent, tool, food = cells.astype(jnp.int32)
    return layout.replace(agent=agent, tool=tool, food=food)


def cells_of(state: State) -> jax.Array:
    """Returns the cells of agent, tool and food of B states, u8[B, 3, 2]."""
    return jnp.stack([state.agent, state.tool, state.food], axis=1).astype(jnp.uint8)


def first_visits(identity: jax.Array) -> jax.Array:
    """Returns f32[T, B], 1 where i32[T, B] is new in its episode, else 0."""
    time = jnp.arange(len(identity), dtype=jnp.int32)
    same = identity[:, None] == identity[None]
    earlier = (time[:, None] > time[None])[..., None]
    return 1.0 - jnp.any(same & earlier, axis=1).astype(jnp.float32)
