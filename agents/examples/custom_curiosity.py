"""A curiosity of one's own: a step pays where the tool moves, less the more it has moved.

python -m agents.examples.custom_curiosity
python -m agents.train --import agents.examples.custom_curiosity --curiosity tool-moves
"""

from typing import Any

import jax
import jax.numpy as jnp

from agents import Config, make_train
from agents.acting.episodes import CELL_TOOL
from agents.curiosity import Curiosity, Experience, register


class ToolMoves(Curiosity):
    """reward: n^(-1/2) for a move of the tool, n the moves in training so far."""

    def memory(self) -> jax.Array:
        """No moves yet, f32[]."""
        return jnp.zeros(())

    def reward(
        self, params: Any, memory: jax.Array, experience: Experience
    ) -> tuple[jax.Array, jax.Array]:
        """The bonus f32[T, B] of every step, and the moves with this iteration's."""
        tool = experience.episodes.cells[:, :, CELL_TOOL]
        moves = jnp.any(tool[1:] != tool[:-1], axis=-1) * experience.episodes.mask
        total = memory + jnp.sum(moves)
        return moves / jnp.sqrt(jnp.maximum(total, 1.0)), total


register("tool-moves", lambda config, env: ToolMoves())


def main(iterations: int = 20, **settings: Any) -> tuple[Any, dict[str, jax.Array]]:
    """Trains with it on base; returns the state of training and the last metrics.

    Args:
      iterations: how many, at least 1.
      settings: those of the preset `fast` to change.
    """
    train = make_train(Config.preset("fast", curiosity="tool-moves", **settings))
    iterate = jax.jit(train.iterate)
    state, metrics = train.init(jax.random.key(0)), {}
    for number in range(1, iterations + 1):
        state, metrics = iterate(state)
        print(
            f"iteration {number}: {state.memory:,.0f} moves of the tool so far, "
            f"{metrics['success']:.1%} of the episodes solved"
        )
    return state, metrics


if __name__ == "__main__":
    main()
