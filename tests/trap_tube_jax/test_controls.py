"""The controls against the oracle and the table of controls.md."""

import itertools
import pathlib
import re

import jax
import numpy as np
import pytest

import trap_tube_jax as tt
from trap_tube_jax.controls import CONTROLS, drawn_from
from trap_tube_jax.solver.search import replay

PAGE = pathlib.Path(tt.__file__).parent / "controls.md"
DIRECTIONS = {(0, 1): "right", (0, -1): "left", (1, 0): "down", (-1, 0): "up"}


def table() -> dict[str, list[tuple[str, str]]]:
    """Shortest plan and first push of every layout, by the short name of its set."""
    rows: dict[str, list[tuple[str, str]]] = {}
    pattern = r"^\| ([a-z-]+) \| [^|]+ \| (\d+|none) \| (\w+) \|"
    for name, length, push in re.findall(pattern, PAGE.read_text(), re.MULTILINE):
        rows.setdefault(name, []).append((length, push))
    return rows


def oracle(state: tt.State) -> tuple[str, str]:
    """What the table says of a layout."""
    plan = tt.solve(state)
    foods = [np.asarray(at.food) for at in replay(state, plan)]
    moves = [tuple((b - a).tolist()) for a, b in itertools.pairwise(foods)]
    pushes = [DIRECTIONS[move] for move in moves if any(move)]
    return str(plan.length) if plan.solvable else "none", pushes[0] if pushes else "none"


@pytest.mark.parametrize("layouts", CONTROLS, ids=lambda layouts: layouts.__name__)
def test_the_oracle_finds_what_the_page_says(layouts):
    assert [oracle(state) for state in layouts()] == table()[layouts.__name__.replace("_", "-")]


def test_the_page_lists_the_sets():
    assert list(table()) == ["base", *(entry.short for entry in tt.CONTROL_TASK_SETS)]
    assert table()["base"] == [oracle(tt.base_state())]


def test_the_turned_trap_makes_the_other_way_longer():
    """Without the right exit, what is left is the way that keeps off the trap."""
    (state,) = CONTROLS[0]()
    board = np.asarray(state.board).copy()
    board[5:7, 7] = tt.base_state().board[4, 4]
    assert tt.solve(state.replace(board=jax.numpy.asarray(board))).length == 16


def test_no_control_is_a_set_of_the_paper():
    paper = {entry.id for entry in tt.PAPER_TASK_SETS}
    assert not paper & {entry.id for entry in tt.CONTROL_TASK_SETS}
    assert {entry.max_steps for entry in tt.CONTROL_TASK_SETS} == {50}
    entry = tt.CONTROL_TASK_SETS[0]
    assert (entry.id, entry.short, entry.label) == (
        "TrapTurnedControl-v0",
        "trap-turned",
        "{trap turned}",
    )


@pytest.mark.parametrize("layouts", CONTROLS, ids=lambda layouts: layouts.__name__)
def test_every_layout_is_drawn_as_often_and_as_it_is(layouts):
    choices = layouts()
    start = tt.base_state(5)
    keys = jax.random.split(jax.random.key(0), 400)
    drawn = jax.device_get(jax.jit(jax.vmap(drawn_from(layouts), (0, None)))(keys, start))
    counts = np.zeros(len(choices), int)
    for index, choice in enumerate(choices):
        same = np.ones(len(keys), bool)
        for name in ("board", "agent", "tool", "tool_extent", "food"):
            field = getattr(drawn, name) == np.asarray(getattr(choice, name))
            same &= field.reshape(len(keys), -1).all(axis=1)
        counts[index] = same.sum()
    assert counts.sum() == len(keys)
    assert np.all(abs(counts - len(keys) / len(choices)) < 50)
    assert np.all(drawn.palette == np.asarray(start.palette))


def test_layouts_compose_with_other_colours():
    env = tt.Environment((*tt.task_set("two-traps").transfers, tt.structural))
    state, _ = jax.jit(env.reset)(jax.random.key(1))
    tt.validate(state)
    assert np.any(np.asarray(state.palette) != np.asarray(tt.base_state().palette))
