"""The programs in `agents/examples`, at small sizes."""

import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents.acting.episodes import Episodes
from agents.curiosity import Experience
from agents.examples import custom_curiosity

SMALL = {
    "episodes": 8, "minibatch": 8, "epochs": 1, "max_steps": 20, "filters": (2, 2), "hidden": 4,
    "embedding": 2, "chunk": 8, "imitation_coef": 0.0,
}  # fmt: skip


def test_a_custom_curiosity_pays_moves_of_the_tool():
    column = jnp.array([[0, 4], [0, 4], [1, 5], [2, 6]])  # of the tool, at 4 times in 2 episodes
    cells = jnp.zeros((4, 2, 3, 2), jnp.uint8).at[:, :, 1, 1].set(column.astype(jnp.uint8))
    mask = jnp.array([[1.0, 1.0], [1.0, 1.0], [1.0, 0.0]])
    nothing = jnp.zeros((3, 2))
    episodes = Episodes(tt.base_state(), cells, nothing, nothing, nothing, mask)
    experience = Experience(episodes, jnp.zeros((4, 2), jnp.int32), jnp.zeros((4, 2, 0)))
    curiosity = custom_curiosity.ToolMoves()
    pay, moves = curiosity.reward({}, jnp.float32(6.0), experience)
    np.testing.assert_allclose(pay, [[0, 0], [1 / 3, 1 / 3], [1 / 3, 0]], rtol=1e-6)
    assert moves == 9


@pytest.mark.slow
def test_a_custom_curiosity_is_trained_with(capsys):
    state, metrics = custom_curiosity.main(iterations=2, **SMALL)
    assert state.memory > 0
    assert metrics["intrinsic_reward"] > 0
    assert capsys.readouterr().out.count("moves of the tool") == 2
