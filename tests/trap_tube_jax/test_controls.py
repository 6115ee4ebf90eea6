"""The controls against the oracle and the table of controls.md."""

import itertools
import pathlib
import re
from collections import Counter

import jax
import numpy as np

import trap_tube_jax as tt
from helpers.trees import rows
from trap_tube_jax.controls import CONTROLS, LayoutDraw, food_outside, with_every_start
from trap_tube_jax.dynamics import replay

PAGE = pathlib.Path(tt.__file__).parent / "controls.md"
DIRECTIONS = {(0, 1): "right", (0, -1): "left", (1, 0): "down", (-1, 0): "up"}


def table() -> dict[str, list[tuple[str, str]]]:
    """Shortest plan and first push of every layout, by the short name of its set."""
    rows: dict[str, list[tuple[str, str]]] = {}
    pattern = r"^\| ([a-z-]+)(?:, [a-z ]+)? \| [^|]+ \| (\d+|none) \| (\w+) \|"
    for name, length, push in re.findall(pattern, PAGE.read_text(), re.MULTILINE):
        rows.setdefault(name, []).append((length, push))
    return rows


def oracle(state: tt.State) -> tuple[str, str]:
    """Returns a layout's entries of the table: plan length and direction of the push."""
    plan = tt.solve(state)
    foods = np.asarray(replay(state, plan.actions).food)
    moves = [tuple((b - a).tolist()) for a, b in itertools.pairwise(foods)]
    pushes = [DIRECTIONS[move] for move in moves if any(move)]
    return str(plan.length) if plan.solvable else "none", pushes[0] if pushes else "none"


def test_the_oracle_finds_what_the_page_says():
    found = {"base": [oracle(tt.base_state())]}
    for entry, layouts in zip(tt.CONTROL_TASK_SETS, CONTROLS, strict=True):
        assert (entry.short, entry.max_steps) == (layouts.__name__.replace("_", "-"), 50)
        found[entry.short] = [oracle(state) for state in layouts()]
    assert found == table()
    assert list(found) == list(table())


def test_the_turned_trap_makes_the_other_way_longer():
    """Without the right exit, what is left is the way that keeps off the trap."""
    (state,) = CONTROLS[0]()
    board = np.asarray(state.board).copy()
    board[5:7, 7] = tt.base_state().board[4, 4]
    assert tt.solve(state.replace(board=jax.numpy.asarray(board))).length == 16


def test_agents_start_from_every_cell_that_they_can_walk_to():
    """Ground without tool and food, outside the tube, which no agent can enter."""
    for state in (tt.base_state(), *food_outside()):
        batch = with_every_start(state)
        starts = set(map(tuple, np.asarray(batch.agent).tolist()))
        cells = set(itertools.product(range(12), repeat=2))
        tube = set(itertools.product(range(4, 8), repeat=2))
        tool = set(itertools.product(range(4, 8), [1]))
        assert starts == cells - tube - tool - {tuple(np.asarray(state.food).tolist())}
        assert all(
            tt.validate(rows(batch, i)).replace(agent=state.agent) == state for i in range(3)
        )


def test_ids_and_labels_follow_the_names_of_the_functions():
    entry = tt.CONTROL_TASK_SETS[0]
    names = (entry.id, entry.short, entry.label)
    assert names == ("TrapTurnedControl-v0", "trap-turned", "trap-turned")


def test_every_layout_is_drawn_as_often_and_as_it_is_in_the_states_colours():
    start = tt.base_state(5)
    keys = jax.random.split(jax.random.key(0), 400)
    for layouts in CONTROLS:
        choices = [state.replace(palette=start.palette) for state in layouts()]
        draw = jax.jit(jax.vmap(LayoutDraw(layouts), (0, None)))
        drawn = jax.device_get(draw(jax.random.clone(keys), start))
        counts = Counter(rows(drawn, index) for index in range(len(keys)))
        assert counts.keys() == set(choices)
        assert all(abs(count - len(keys) / len(choices)) < 50 for count in counts.values())
