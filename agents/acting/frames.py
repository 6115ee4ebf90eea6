"""A frame of reference: the board, turned and mirrored so that the food lies ahead.

The rules are the same under the eight symmetries of the board. So an agent may look at a mirror
image and act in it. One that chooses the image by the food's position relative to its own, as it
first sees them, has an eighth of the situations to learn. The frame holds for the episode.

Source: own; frames are averaged over, and chosen, in Puny et al. (2022).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from trap_tube_jax.objects import AGENT, BOARD_SIZE, DOWN, FOOD, LEFT, NUM_DIRECTIONS, RIGHT, UP
from trap_tube_jax.state import State, base_state


class Frame(NamedTuple):
    """One of the eight images of the board.

    It is mirrored at the main diagonal or not, then upside down or not, then left to right or not.

    Attributes:
      transposed: bool[].
      top_down: bool[].
      left_right: bool[].
    """

    transposed: jax.Array
    top_down: jax.Array
    left_right: jax.Array

    @staticmethod
    def of(number: jax.Array) -> "Frame":
        """That of a number from 0, the board as it is, to 7."""
        return Frame(number % 2 == 1, number // 2 % 2 == 1, number // 4 == 1)

    @staticmethod
    def facing_food(observation: jax.Array) -> "Frame":
        """The frame in which food lies below the agent, at most as far to the right as below.

        Agent and food are found in the observation u8[12, 12, N] by their colours. The board stays
        as it is where one of them is not to be seen.
        """
        palette = base_state(observation.shape[-1]).palette
        agent, food = (_first_cell(observation, palette[thing]) for thing in (AGENT, FOOD))
        offset = jnp.where(jnp.all(agent >= 0) & jnp.all(food >= 0), food - agent, 0)
        transposed = jnp.abs(offset[1]) > jnp.abs(offset[0])
        offset = jnp.where(transposed, offset[::-1], offset)
        return Frame(transposed, offset[0] < 0, offset[1] < 0)

    def picture(self, board: jax.Array) -> jax.Array:
        """The image of cells [12, 12, ...]."""
        board = jnp.where(self.transposed, board.swapaxes(0, 1), board)
        board = jnp.where(self.top_down, board[::-1], board)
        return jnp.where(self.left_right, board[:, ::-1], board)

    def state(self, state: State) -> State:
        """The image of a state."""
        extent = jnp.where(self.transposed, state.tool_extent[::-1], state.tool_extent)
        one_cell = jnp.ones_like(extent)
        return state.replace(
            board=self.picture(state.board),
            tool_extent=extent,
            agent=self._corner(state.agent, one_cell),
            tool=self._corner(state.tool, extent),
            food=self._corner(state.food, one_cell),
        )

    def action(self, action: jax.Array) -> jax.Array:
        """The image of an action i32[..., 2]."""
        return self._directions()[action]

    def original_action(self, action: jax.Array) -> jax.Array:
        """The action i32[..., 2] whose image this is; undoes `action`."""
        return jnp.argsort(self._directions())[action]

    def _corner(self, cell: jax.Array, extent: jax.Array) -> jax.Array:
        """The top-left cell i32[2] of the image of a bar with this top-left cell.

        Args:
          cell: i32[2].
          extent: i32[2], the image's.
        """
        cell = jnp.where(self.transposed, cell[::-1], cell)
        flips = jnp.stack([self.top_down, self.left_right])
        return jnp.where(flips, BOARD_SIZE - extent - cell, cell)

    def _directions(self) -> jax.Array:
        """i32[4]: what becomes of every direction."""
        image = jnp.arange(NUM_DIRECTIONS)
        for applies, swapped in (
            (self.transposed, (LEFT, RIGHT, UP, DOWN)),
            (self.top_down, (DOWN, UP, LEFT, RIGHT)),
            (self.left_right, (UP, DOWN, RIGHT, LEFT)),
        ):
            image = jnp.where(applies, jnp.asarray(np.array(swapped))[image], image)
        return image


def _first_cell(observation: jax.Array, color: jax.Array) -> jax.Array:
    """The first cell i32[2] with this colour u8[N]; -1, -1 if there is none."""
    has_color = jnp.all(observation == color[None, None], axis=-1).reshape(-1)
    place = jnp.argmax(has_color)
    cell = jnp.stack([place // BOARD_SIZE, place % BOARD_SIZE]).astype(jnp.int32)
    return jnp.where(jnp.any(has_color), cell, -1)
