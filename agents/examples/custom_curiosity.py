"""A curiosity of your own: it pays for moves of the tool, less the more there have been.

python -m agents.examples.custom_curiosity
python -m agents.train --import agents.examples.custom_curiosity --curiosity tool-moves
"""

import argparse
from typing import Any

import jax
import jax.numpy as jnp

from agents import Config, TrainState, make_train
from agents.acting.episodes import CELL_TOOL
from agents.curiosity import Curiosity, Experience, register


class ToolMoves(Curiosity):
    """reward: n^(-1/2) for a move of the tool, n the moves in training so far."""

    def memory(self) -> jax.Array:
        """Returns no moves, f32[]."""
        return jnp.zeros((), jnp.float32)

    def reward(
        self, params: Any, memory: jax.Array, experience: Experience
    ) -> tuple[jax.Array, jax.Array]:
        """Returns the reward f32[T, B] of every step, and the moves so far."""
        tool = experience.episodes.cells[:, :, CELL_TOOL]
        moves = jnp.any(tool[1:] != tool[:-1], axis=-1) * experience.episodes.mask
        total = memory + jnp.sum(moves)
        return moves / jnp.sqrt(jnp.maximum(total, 1.0)), total


register("tool-moves", lambda config, env: ToolMoves())


def main(config: Config, iterations: int = 20) -> tuple[TrainState, dict[str, jax.Array]]:
    """Trains for at least one iteration; returns the last state and metrics."""
    learner = make_train(config)
    iterate = jax.jit(learner.iterate)
    state, metrics = learner.init(jax.random.key(0)), {}
    for number in range(1, iterations + 1):
        state, metrics = iterate(state)
        print(
            f"iteration {number}: {state.memory:,.0f} moves of the tool so far, "
            f"{metrics['success']:.1%} of the episodes solved"
        )
    return state, metrics


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    main(Config.preset("fast", curiosity="tool-moves"))
