"""The eight symmetries of the board, under which the rules do not change.

What is right on a board is right on its mirror image, with directions mirrored too. Learning
from images is learning from eight times as many tasks.

Source: augmentation in reinforcement learning, Laskin et al. (2020).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from trap_tube_jax.objects import BOARD_SIZE, DOWN, LEFT, NUM_DIRECTIONS, RIGHT, UP
from trap_tube_jax.state import State

NUM_SYMMETRIES = 8
TOOL = 1  # of agent, tool and food


class Symmetry(NamedTuple):
    """One of the eight: first mirrored at the diagonal or not, then top down, then left right.

    Attributes:
      transposed: bool[].
      top_down: bool[].
      left_right: bool[].
    """

    transposed: jax.Array
    top_down: jax.Array
    left_right: jax.Array

    @staticmethod
    def of(number: jax.Array) -> "Symmetry":
        """That of a number from 0, which changes nothing, to 7."""
        return Symmetry(number % 2 == 1, number // 2 % 2 == 1, number // 4 == 1)

    def layout(self, layout: State) -> State:
        """The image of states [B] as far as board and tool extent go."""
        board, extent = layout.board, layout.tool_extent
        board = jnp.where(self.transposed, board.swapaxes(1, 2), board)
        board = jnp.where(self.top_down, board[:, ::-1], board)
        board = jnp.where(self.left_right, board[:, :, ::-1], board)
        extent = jnp.where(self.transposed, extent[:, ::-1], extent)
        return layout.replace(board=board, tool_extent=extent)

    def cells(self, cells: jax.Array, extent: jax.Array) -> jax.Array:
        """The image of cells u8[T, B, 3, 2] of agent, tool and food.

        Args:
          cells: the tool's is its top left one.
          extent: i32[B, 2], the tool's, before.
        """
        cells = jnp.where(self.transposed, cells[..., ::-1], cells)
        extent = jnp.where(self.transposed, extent[:, ::-1], extent)
        # The tool's top left cell becomes another corner.
        reach = jnp.zeros((*cells.shape[1:],), cells.dtype)
        reach = reach.at[:, TOOL].set((extent - 1).astype(cells.dtype))
        flipped = (BOARD_SIZE - 1) - cells - reach[None]
        flips = jnp.stack([self.top_down, self.left_right]).reshape(1, 1, 1, 2)
        return jnp.where(flips, flipped, cells)

    def directions(self) -> jax.Array:
        """i32[4]: what becomes of every direction."""
        image = jnp.arange(NUM_DIRECTIONS)
        for applies, swaps in (
            (self.transposed, ((UP, LEFT), (DOWN, RIGHT))),
            (self.top_down, ((UP, DOWN),)),
            (self.left_right, ((LEFT, RIGHT),)),
        ):
            image = jnp.where(applies, jnp.asarray(_swap(swaps))[image], image)
        return image


def _swap(pairs: tuple[tuple[int, int], ...]) -> np.ndarray:
    image = np.arange(NUM_DIRECTIONS)
    for one, other in pairs:
        image[one], image[other] = other, one
    return image
