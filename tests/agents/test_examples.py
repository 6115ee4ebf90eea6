"""The programs in `agents/examples`, at small sizes."""

import runpy
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents.acting.episodes import Episodes
from agents.curiosity import Experience
from agents.examples import custom_curiosity, custom_transfer, oracle
from small_runs import small_config


def test_a_custom_curiosity_pays_moves_of_the_tool():
    column = jnp.array([[0, 4], [0, 4], [1, 5], [2, 6]])  # of the tool, at 4 times in 2 episodes
    cells = jnp.zeros((4, 2, 3, 2), jnp.uint8).at[:, :, 1, 1].set(column.astype(jnp.uint8))
    mask = jnp.array([[1.0, 1.0], [1.0, 1.0], [1.0, 0.0]])
    nothing = jnp.zeros((3, 2))
    episodes = Episodes(tt.base_state(), cells, nothing, nothing, nothing, mask, nothing)
    experience = Experience(episodes, jnp.zeros((4, 2, 0)))
    curiosity = custom_curiosity.ToolMoves()
    pay, moves = curiosity.reward({}, jnp.float32(6.0), experience)
    np.testing.assert_allclose(pay, [[0, 0], [1 / 3, 1 / 3], [1 / 3, 0]], rtol=1e-6)
    assert moves == 9


@pytest.mark.parametrize("name", ["custom_curiosity", "custom_transfer", "oracle", "plain_ppo"])
def test_help_explains_a_program_instead_of_running_it(name, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    monkeypatch.delitem(sys.modules, f"agents.examples.{name}", raising=False)
    with pytest.raises(SystemExit) as stopped:
        runpy.run_module(f"agents.examples.{name}", run_name="__main__")
    assert stopped.value.code == 0
    assert "usage:" in capsys.readouterr().out


@pytest.mark.slow
def test_a_custom_curiosity_is_trained_with(capsys):
    config = small_config(curiosity="tool-moves", max_steps=20)
    state, metrics = custom_curiosity.main(config, iterations=2)
    assert state.memory > 0
    assert metrics["intrinsic_reward"] > 0
    assert capsys.readouterr().out.count("moves of the tool") == 2


def test_a_custom_transfer():
    base = tt.base_state()
    draws = jax.jit(jax.vmap(custom_transfer.mirrored, in_axes=(0, None)))
    states = draws(jax.random.split(jax.random.key(0), 64), base)
    turned = np.any(np.asarray(states.board) != np.asarray(base.board), axis=(1, 2))
    assert 16 < turned.sum() < 48
    boards = np.asarray(jax.vmap(tt.observe)(states))
    np.testing.assert_array_equal(boards[turned][0], boards[~turned][0][:, ::-1])
    assert set(tt.solve_batch(states).length.tolist()) == {11}
    scores = custom_transfer.main(tasks=64)
    assert scores["base"].solved == 1
    assert scores["mirrored"].percent < 80


def test_the_oracle_bounds_an_agent(capsys):
    bounds = oracle.main(sets=("base", "sy"), tasks=10)
    assert bounds == {"base": 100.0, "sy": 100.0}
    shown = capsys.readouterr().out
    assert "base: 100.0 % can be solved, in 11.0 steps" in shown
    assert "optimality" in shown
