"""Counts of layouts: those of {P}, and those that a training run meets."""

import numpy as np
import pytest

from agents import Config
from trap_tube_jax.layouts import NUM_ASSIGNMENTS, NUM_FRAMES, layout_tables
from trap_tube_jax.objects import TUBE1, TUBE2
from trap_tube_jax.transfers import SYMBOLIC_OBJECTS


@pytest.fixture(scope="module")
def layouts() -> tuple[np.ndarray, np.ndarray]:
    """Of layouts that are equally likely: the chance f64[K] of each, and how many i64[K] there are.

    Layouts that look the same are one.
    """
    tables = layout_tables()
    looks = np.where(tables.board == TUBE2, TUBE1, tables.board)
    frames = np.concatenate([looks.reshape(NUM_FRAMES, -1), tables.extent], axis=1)
    _, first, times = np.unique(frames, axis=0, return_index=True, return_counts=True)
    chances, counts = [], []
    for frame, share in zip(first, times / NUM_FRAMES, strict=True):
        _, boards = np.unique(looks[frame], axis=0, return_counts=True)
        foods = np.full(tables.num_food[frame], 1 / tables.num_food[frame])
        num_tools = tables.num_tools[frame]
        agents = tables.num_agents[frame, :num_tools]
        inside = np.multiply.outer(boards / NUM_ASSIGNMENTS, foods)
        chance = share * np.multiply.outer(inside, 1 / (num_tools * agents))
        chances.append(chance.ravel())
        counts.append(np.broadcast_to(agents, chance.shape).ravel())
    return np.concatenate(chances), np.concatenate(counts)


def test_number_of_layouts(layouts):
    chance, count = layouts
    assert count.sum() == 440_672
    np.testing.assert_allclose(np.sum(chance * count), 1)


@pytest.mark.parametrize(
    ("preset", "tasks", "met", "met_with_the_bar"),
    [("best", 36_800, 0.082, 0.017), ("paper", 512_000, 0.69, 0.21)],
)
def test_layouts_that_a_run_meets(layouts, preset, tasks, met, met_with_the_bar):
    """The chance that a layout of {P} has been drawn before, as protocol.md says."""
    config = Config.preset(preset, env_id="pstsy")
    iterations = {"best": config.iterations, "paper": 500}[preset]
    assert config.num_new * iterations == tasks
    chance, count = layouts
    for share, expected in ((1, met), (1 / len(SYMBOLIC_OBJECTS), met_with_the_bar)):
        is_met = 1 - (1 - share * chance) ** tasks
        assert np.sum(chance * count * is_met) == pytest.approx(expected, rel=0.01)
