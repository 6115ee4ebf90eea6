"""The programs in `agents/examples`, at small sizes."""

import runpy
import sys

import jax
import numpy as np
import pytest

import trap_tube_jax as tt
from agents.examples import custom_transfer


@pytest.mark.parametrize("name", ["custom_transfer", "plain_ppo"])
def test_help_explains_a_program_instead_of_running_it(name, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    monkeypatch.delitem(sys.modules, f"agents.examples.{name}", raising=False)
    with pytest.raises(SystemExit) as stopped:
        runpy.run_module(f"agents.examples.{name}", run_name="__main__")
    assert stopped.value.code == 0
    assert "usage:" in capsys.readouterr().out


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
