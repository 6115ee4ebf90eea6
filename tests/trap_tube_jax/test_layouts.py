"""Counts of the layouts of {P}, and of those that a training run meets."""

import numpy as np
import pytest

import agents
from agents import Config
from helpers.paths import ROOT
from trap_tube_jax.layouts import NUM_ASSIGNMENTS, NUM_OUTLINES, layout_tables
from trap_tube_jax.objects import TUBE1, TUBE2
from trap_tube_jax.transfers import SYMBOLIC_OBJECTS


@pytest.fixture(scope="module")
def layouts() -> tuple[np.ndarray, np.ndarray]:
    """Groups equally likely layouts: the probability f64[K] of one, and their number i64[K].

    Layouts that look the same are one.
    """
    tables = layout_tables()
    looks = np.where(tables.board == TUBE2, TUBE1, tables.board)
    outlines = np.concatenate([looks.reshape(NUM_OUTLINES, -1), tables.extent], axis=1)
    _, first, times = np.unique(outlines, axis=0, return_index=True, return_counts=True)
    chances = []
    counts = []
    for outline, share in zip(first, times / NUM_OUTLINES, strict=True):
        _, boards = np.unique(looks[outline], axis=0, return_counts=True)
        foods = np.full(tables.num_food[outline], 1 / tables.num_food[outline])
        num_tools = tables.num_tools[outline]
        agents = tables.num_agents[outline, :num_tools]
        inside = np.multiply.outer(boards / NUM_ASSIGNMENTS, foods)
        chance = share * np.multiply.outer(inside, 1 / (num_tools * agents))
        chances.append(chance.ravel())
        counts.append(np.broadcast_to(agents, chance.shape).ravel())
    return np.concatenate(chances), np.concatenate(counts)


def test_number_of_layouts(layouts):
    chance, count = layouts
    assert count.sum() == 440_672
    np.testing.assert_allclose(np.sum(chance * count), 1)


def most_tasks(config: Config, iterations: int) -> int:
    """Returns an upper bound: the new tasks, and those that fill the lists of failed ones."""
    return config.num_new * iterations + config.replay_capacity * len(config.replay_fractions)


def test_the_share_of_layouts_that_training_meets_is_the_documented_one(layouts):
    """The chance that a layout of {P} has been drawn before is what protocol.md says."""
    chance, count = layouts

    def met(tasks: int, share: float) -> float:
        return 100 * np.sum(chance * count * (1 - (1 - share * chance) ** tasks))

    best = Config.preset("best")
    few = most_tasks(best, best.iterations)
    many = Config.preset("paper").num_new * 500
    bar = 1 / len(SYMBOLIC_OBJECTS)
    finetuned = agents.load("colors-finetuned")
    with_colors = sum(
        most_tasks(finetuned.config, count) for count in (best.iterations, finetuned.iteration)
    )
    page = " ".join((ROOT / "trap_tube_jax" / "protocol.md").read_text().split())
    assert (
        f"The tasks of a `best` run, at most {few:,}, include up to {met(few, 1):.1f} % of the "
        f"scored {{P}} layouts in other colours, {met(few, bar):.1f} % with the bar as the tool; "
        f"the {many:,} of a run of `exp2`, {met(many, 1):.0f} and {met(many, bar):.0f} %; those "
        f"of `colors-finetuned`, at most {with_colors:,}, up to {met(with_colors, 1 / 2):.0f} % "
        "of the scored {P} tasks themselves"
    ) in page
