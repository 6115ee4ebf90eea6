"""Shares an easy task among the tests of the adapters, and makes room for other people's code."""

import jax
import pytest

import trap_tube_jax as tt


@pytest.fixture(autouse=True)
def _allow_rank_promotion():
    """Allows broadcasting between ranks, which other libraries use and the other tests forbid."""
    with jax.numpy_rank_promotion("allow"):
        yield


@pytest.fixture(scope="session")
def easy_env():
    """Food two steps from the agent: a random agent finds it now and then, PPO soon always."""
    rows = [
        "TTTT........",
        *["............"] * 4,
        ".....A......",
        ".....1F.....",
        *["............"] * 5,
    ]
    base = tt.State.from_ascii(rows)
    return tt.Environment(base=base, max_steps=6)
