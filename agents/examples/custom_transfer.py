"""Registers a custom transfer, and scores an agent that was trained without this transfer.

python -m agents.examples.custom_transfer
"""

import argparse

import jax
import jax.numpy as jnp

import agents
import trap_tube_jax as tt
from trap_tube_jax.objects import BOARD_SIZE


def mirrored(key: jax.Array, state: tt.State) -> tt.State:
    """Mirrors the board left to right with probability 1/2; shortest plans keep their length."""
    last = BOARD_SIZE - 1
    image = state.replace(
        board=state.board[:, ::-1],
        agent=state.agent.at[1].set(last - state.agent[1]),
        food=state.food.at[1].set(last - state.food[1]),
        tool=state.tool.at[1].set(last - state.tool[1] - (state.tool_extent[1] - 1)),
    )
    is_mirrored = jax.random.bernoulli(key)
    return jax.tree.map(lambda x, y: jnp.where(is_mirrored, x, y), image, state)


tt.register("MirroredTrapTube-v0", (mirrored,), short="mirrored")


def main(tasks: int = 100) -> tt.Scores:
    """Scores the shipped agent `fast-base` on base and on this number of tasks of the new set."""
    scores = tt.score(agents.load("fast-base"), sets=["base", "mirrored"], tasks=tasks)
    print(scores)
    return scores


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    main()
