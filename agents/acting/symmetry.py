"""Symmetries of the board, which turn and mirror it so that the food is ahead.

The rules are invariant under the eight symmetries of the board, so an agent may see an image of the
board and act in that image. Choosing the image by the direction of the food at the first
observation leaves an eighth of the situations to learn. The symmetry holds for the whole episode.

Source: this project; Puny et al. (2022) average over frames, and choose them.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import trap_tube_jax as tt
from trap_tube_jax.geometry import cell_of
from trap_tube_jax.objects import AGENT, BOARD_SIZE, DOWN, FOOD, LEFT, NUM_DIRECTIONS, RIGHT, UP


class Symmetry(NamedTuple):
    """One of the eight symmetries of the board.

    The flags bool[] mirror the board along the main diagonal, then top to bottom, then left to
    right.
    """

    transposed: jax.Array
    top_down: jax.Array
    left_right: jax.Array

    @staticmethod
    def from_index(index: jax.Array) -> "Symmetry":
        """Returns symmetry `index` (0 to 7); 0 is the identity."""
        return Symmetry(index % 2 == 1, index // 2 % 2 == 1, index // 4 == 1)

    @staticmethod
    def facing_food(observation: jax.Array) -> "Symmetry":
        """Returns the symmetry that puts the food below the agent.

        The food is then at most as far to the right as below. Finds both in u8[12, 12, N] by their
        colours; the identity if one is not visible.
        """
        palette = tt.base_palette(observation.shape[-1])
        agent, food = (_first_cell(observation, palette[thing]) for thing in (AGENT, FOOD))
        offset = jnp.where(jnp.all(agent >= 0) & jnp.all(food >= 0), food - agent, 0)
        transposed = jnp.abs(offset[1]) > jnp.abs(offset[0])
        offset = jnp.where(transposed, offset[::-1], offset)
        return Symmetry(transposed, offset[0] < 0, offset[1] < 0)

    def transform_board(self, board: jax.Array) -> jax.Array:
        """Returns the image of cells [12, 12, ...]."""
        board = jnp.where(self.transposed, board.swapaxes(0, 1), board)
        board = jnp.where(self.top_down, board[::-1], board)
        return jnp.where(self.left_right, board[:, ::-1], board)

    def transform_state(self, state: tt.State) -> tt.State:
        """Returns the image of a state."""
        extent = jnp.where(self.transposed, state.tool_extent[::-1], state.tool_extent)
        one_cell = jnp.ones_like(extent)
        return state.replace(
            board=self.transform_board(state.board),
            tool_extent=extent,
            agent=self._corner(state.agent, one_cell),
            tool=self._corner(state.tool, extent),
            food=self._corner(state.food, one_cell),
        )

    def original_action(self, action: jax.Array) -> jax.Array:
        """Returns the action i32[..., 2] whose image is `action`."""
        direction = np.arange(NUM_DIRECTIONS, dtype=np.int32)
        for applies, swapped in (
            (self.left_right, (UP, DOWN, RIGHT, LEFT)),
            (self.top_down, (DOWN, UP, LEFT, RIGHT)),
            (self.transposed, (LEFT, RIGHT, UP, DOWN)),
        ):
            image = jnp.asarray(swapped, jnp.int32)[direction]
            direction = jnp.where(applies, image, direction)
        return jnp.asarray(direction)[action]

    def _corner(self, cell: jax.Array, extent: jax.Array) -> jax.Array:
        """Returns the top-left cell i32[2] of the image of a bar, whose image has this extent."""
        cell = jnp.where(self.transposed, cell[::-1], cell)
        flips = jnp.stack([self.top_down, self.left_right])
        return jnp.where(flips, BOARD_SIZE - extent - cell, cell)


def _first_cell(observation: jax.Array, color: jax.Array) -> jax.Array:
    """Returns the first cell i32[2] of this colour u8[N]; (-1, -1) if there is none."""
    has_color = jnp.all(observation == color[None, None], axis=-1).reshape(-1)
    index = jnp.argmax(has_color).astype(jnp.int32)
    return jnp.where(jnp.any(has_color), cell_of(index), -1)
