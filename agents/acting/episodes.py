"""The record of episodes that acting and learning share."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

import trap_tube_jax as tt
from trap_tube_jax.positions import position_id


class Episodes(NamedTuple):
    """B episodes of T steps; after an early end, the last state repeats.

    Step t leads from observation t to observation t + 1.

    Attributes:
      layout: B states, whose board, palette and tool extent hold for the episode.
      cells: u8[B, T + 1, 3, 2], (row, column) of agent, tool and food at every observation.
      action: i32[B, T, 2], (grasp, move).
      reward: f32[B, T], extrinsic.
      discount: f32[B, T], 0 on the step that terminated the episode and after it, else 1.
      mask: f32[B, T], 1 on the steps that the episode took, with the last one, and 0 on padding.
    """

    layout: tt.State
    cells: jax.Array
    action: jax.Array
    reward: jax.Array
    discount: jax.Array
    mask: jax.Array

    @property
    def agent(self) -> jax.Array:
        """u8[B, T + 1, 2], the agent's (row, column)."""
        return self.cells[:, :, 0]

    @property
    def tool(self) -> jax.Array:
        """u8[B, T + 1, 2], the (row, column) of the tool's top-left cell."""
        return self.cells[:, :, 1]

    @property
    def food(self) -> jax.Array:
        """u8[B, T + 1, 2], the food's (row, column)."""
        return self.cells[:, :, 2]

    @property
    def solved(self) -> jax.Array:
        """bool[B], episodes with a reward."""
        return jnp.any(self.reward > 0, axis=1)

    @property
    def length(self) -> jax.Array:
        """i32[B], steps taken."""
        return jnp.sum(self.mask, axis=1).astype(jnp.int32)

    def states(self) -> tt.State:
        """Returns the state of every observation, a tree of arrays [B, T + 1, ...]."""
        return jax.vmap(jax.vmap(with_cells, in_axes=(None, 0)))(self.layout, self.cells)

    def observations(self) -> jax.Array:
        """Returns all observations, u8[B, T + 1, 12, 12, N]."""
        return jax.vmap(jax.vmap(tt.observe))(self.states())

    def position_ids(self) -> jax.Array:
        """Returns i32[B, T + 1], equal within an episode only for equal observations."""
        return jax.vmap(jax.vmap(position_id))(self.states())


def with_cells(layout: tt.State, cells: jax.Array) -> tt.State:
    """Returns the layout with agent, tool and food at `cells` u8[3, 2]."""
    agent, tool, food = cells.astype(jnp.int32)
    return layout.replace(agent=agent, tool=tool, food=food)


def cells_of(state: tt.State) -> jax.Array:
    """Returns the cells of agent, tool and food of one state, u8[3, 2]."""
    return jnp.stack([state.agent, state.tool, state.food]).astype(jnp.uint8)
