"""Measures of a profile, of a shipped agent and of tables made by hand."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import trap_tube_jax as tt
from agents import load
from agents.acting.evaluation import Evaluation
from agents.profiles import tasks
from agents.profiles.measure import (
    control_table,
    episodes,
    is_direct,
    knowledge_table,
    profile,
    success_table,
)
from agents.profiles.tasks import first_grasps, first_pushes, plan_lengths
from trap_tube_jax.controls import food_outside, trap_turned
from trap_tube_jax.objects import EXIT, NUM_OBJECTS, TRAP
from trap_tube_jax.scoring.tasks import fixed_tasks

UP, DOWN, LEFT, RIGHT = range(4)


@pytest.fixture(scope="module")
def policy():
    return load("fast-base")


def batch_of_one(state):
    return jax.tree.map(lambda x: np.asarray(x)[None], state)


@pytest.fixture(scope="module")
def measured(policy):
    parts = ("structural", "kind", "plan-length", "first-push-p", "first-grasp-psy", "control")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tasks, "with_every_start", batch_of_one)  # solving all starts takes long
        return profile({"mine": policy}, parts, (0.0, 1.0), 6)


def row(table, part, level):
    return table.set_index(["part", "level"]).loc[part, level]


def test_each_episode_is_counted_once_in_its_part(measured):
    assert measured.groupby("part", sort=False)["tasks"].sum().tolist() == [7, 6, 6, 6, 6, 14]
    is_control = measured["part"] == "control"
    assert (measured["direct"].notna() == is_control).all()
    assert (measured["solved"] <= measured["solved_100"]).all()


def test_means_are_over_solved_tasks(measured):
    base = row(measured, "structural", "0")
    assert base["optimality"] == pytest.approx(11 / base["steps"])
    failed = row(measured, "control", "food-outside, near")
    assert failed[["tasks", "solved", "plan"]].tolist() == [1, 0, 5]
    assert failed[["steps", "optimality"]].isna().all()
    assert pd.isna(row(measured, "control", "too-short-tool")["plan"])  # it has none


def test_groups_by_plan_length_rise_and_hold_their_lengths(measured):
    groups = measured[measured["part"] == "plan-length"]
    assert groups["plan"].is_monotonic_increasing
    for level, plan in zip(groups["level"], groups["plan"], strict=True):
        low, high = map(int, level.split("-"))
        assert low <= plan <= high == low + 4


RIGHTWARD = [(UP, UP), *[(UP, RIGHT)] * 6, (DOWN, RIGHT), *[(UP, UP)] * 3]


@pytest.mark.parametrize(
    ("state", "actions", "length", "expected"),
    [
        # The shortest plan pushes to the right.
        (trap_turned()[0], RIGHTWARD, 11, (1, 1, 1)),
        (trap_turned()[0], RIGHTWARD, 50, (1, 1, 1)),
        (trap_turned()[0], RIGHTWARD, 51, (0, 1, 0)),
        # Food in reach: a plan that leaves the tool where it is, and one that moves it first.
        (food_outside()[1], [(UP, DOWN), (UP, UP)], 2, (1, 1, 1)),
        (food_outside()[1], [(UP, UP), (UP, UP)], 2, (1, 1, 0)),
    ],
)
def test_solutions_within_50_and_100_steps_and_direct_ones(state, actions, length, expected):
    task = batch_of_one(state)
    played = Evaluation(
        solved=jnp.array([True]),
        length=jnp.array([length]),
        action=jnp.array([actions + [(DOWN, DOWN)] * (100 - len(actions))]),
        value=jnp.zeros((1, 100)),
    )
    row = episodes(task, played, tt.solve_batch(task)).iloc[0]
    assert tuple(row[["solved", "solved_100", "direct"]]) == expected


def test_first_pushes_by_shortest_plans_are_right_unless_trap_and_exit_are_exchanged():
    task = jax.device_get(fixed_tasks(tt.make("p"), "profile", 16))
    plan = tt.solve_batch(task)
    played = Evaluation(
        solved=jnp.ones(16, bool),
        length=jnp.asarray(plan.length),
        action=jnp.asarray(plan.actions),
        value=jnp.zeros(plan.actions.shape[:2]),
    )
    code = np.arange(NUM_OBJECTS)
    code[[TRAP, EXIT]] = [EXIT, TRAP]
    exchanged = task.replace(board=code[task.board].astype(np.uint8))
    choices = {
        name: episodes(states, played, plan)[["choices", "right"]].sum().tolist()
        for name, states in (("task", task), ("exchanged", exchanged))
    }
    assert choices["task"][0] == choices["task"][1] > 0
    assert choices["exchanged"][0] > choices["exchanged"][1] == 0


def test_a_push_against_the_planned_direction_is_not_direct():
    food = np.array([[[5, 5], [5, 5], [5, 6]], [[5, 5], [5, 4], [5, 5]], [[5, 5]] * 3])
    tool = np.array([[[4, 1], [4, 2], [4, 2]]] * 2 + [[[4, 1]] * 3])
    planned = np.array([(0, 1)] * 3)
    assert is_direct(tool, food, planned).tolist() == [True, False, True]
    assert is_direct(tool, food, 0 * planned).tolist() == [False, False, True]


def test_episodes_are_grouped_by_plan_length_first_push_and_first_grasp():
    table = pd.DataFrame(
        {"plan": [11.0, 9.0, 10.0], "choice": [0, -1, 1], "grasp": [-1, 0, 1]},
    )
    lengths = plan_lengths(table)
    pushes = first_pushes(table)
    assert list(lengths) == ["10-14", "5-9", "10-14"]
    assert list(lengths.categories) == ["5-9", "10-14"]
    assert list(pushes) == ["no choice", "away from it", "to the exit"]
    assert list(first_grasps(table)) == ["another object", "no grasp", "the tool"]


def test_policies_that_see_different_features_are_refused(policy):
    other = policy.replace(config=dataclasses.replace(policy.config, num_features=1))
    with pytest.raises(ValueError, match=r"one num_features together, got \[1, 3\]"):
        profile({"mine": policy, "other": other})


def test_tables_have_columns_for_each_policy():
    rows = [
        {"policy": policy, "part": "control", "level": level, "tasks": 4, "solved": solved}
        | {"solved_100": 4, "direct": 1.0}
        for policy, counts in {"b": (1, 2), "a": (3, 4)}.items()
        for level, solved in zip(("y", "x"), counts, strict=True)
    ]
    table = pd.DataFrame(rows)
    success = success_table(table)
    assert list(success.columns) == [(p, f"{n} steps") for p in "ba" for n in (50, 100)]
    assert success.reset_index().to_numpy().tolist() == [
        ["control", "y", 4, "25.0 [5, 70]", "100.0", "75.0 [30, 95]", "100.0"],
        ["control", "x", 4, "50.0 [15, 85]", "100.0", "100.0 [51, 100]", "100.0"],
    ]
    assert control_table(table).to_numpy().tolist() == [["25.0 [5, 70]"] * 2] * 2


def test_knowledge_is_the_share_of_first_pushes_and_grasps_that_were_right():
    counts = {
        ("first-push-p", "to the exit"): (110, 109),
        ("first-push-p", "away from it"): (123, 100),
        ("first-push-p", "no choice"): (767, 700),
        ("first-grasp-psy", "the tool"): (2, 2),
        ("first-grasp-psy", "another object"): (6, 3),
    }
    rows = [
        {"policy": "a", "part": part, "level": level, "tasks": tasks, "solved": solved}
        for (part, level), (tasks, solved) in counts.items()
    ]
    rows.append(rows[2] | {"policy": "b"})
    table = knowledge_table(pd.DataFrame(rows))
    assert table.to_numpy().tolist() == [
        ["233", "47.2 [41, 54]", "99.1 [95, 100]", "81.3 [74, 87]"],
        ["8", "25.0 [7, 59]", "100.0 [34, 100]", "50.0 [19, 81]"],
        ["0", "-", "-", "-"],
    ]
