"""Measures of a profile, of a shipped agent and of tables made by hand."""

import dataclasses

import pandas as pd
import pytest

from agents import load
from agents.profiles.measure import FAILED, failure_table, profile, success_table


@pytest.fixture(scope="module")
def policy():
    return load("fast-base")


@pytest.fixture(scope="module")
def measured(policy):
    parts = ("structural", "kind", "plan-length", "control")
    return profile({"mine": policy}, parts, (0.0, 1.0), 6)


def row(table, part, level):
    return table.set_index(["part", "level"]).loc[part, level]


def test_each_episode_is_solved_or_failed_after_one_last_subgoal(measured):
    assert (measured["solved"] + measured[FAILED].sum(axis=1) == measured["tasks"]).all()
    assert measured.groupby("part", sort=False)["tasks"].sum().tolist() == [7, 6, 6, 14]


def test_means_are_of_the_solved_tasks(measured):
    base = row(measured, "structural", "0")
    assert base["optimality"] == pytest.approx(11 / base["steps"])
    failed = row(measured, "control", "food-outside, near")
    assert failed[["solved", "plan", "failed: food out"]].tolist() == [0, 5, 1]
    assert failed[["steps", "optimality"]].isna().all()
    assert pd.isna(row(measured, "control", "too-short-tool")["plan"])  # it has none


def test_groups_by_plan_length_rise_and_hold_their_lengths(measured):
    groups = measured[measured["part"] == "plan-length"]
    assert groups["plan"].is_monotonic_increasing
    for level, plan in zip(groups["level"], groups["plan"], strict=True):
        low, high = map(int, level.split("-"))
        assert low <= plan <= high == low + 4


def test_policies_that_see_different_features_are_refused(policy):
    other = policy.replace(config=dataclasses.replace(policy.config, num_features=1))
    with pytest.raises(ValueError, match=r"one num_features together, got \[1, 3\]"):
        profile({"mine": policy, "other": other})


def test_tables_have_a_column_for_each_policy_and_subgoal():
    rows = [
        {"policy": policy, "part": "kind", "level": level, "tasks": 4, "solved": solved}
        | dict.fromkeys(FAILED, 0)
        | {"failed: none": 4 - solved}
        for policy, counts in {"b": (1, 2), "a": (3, 4)}.items()
        for level, solved in zip(("y", "x"), counts, strict=True)
    ]
    success = success_table(pd.DataFrame(rows))
    assert success.reset_index().to_numpy().tolist() == [
        ["kind", "y", 4, 25.0, 75.0],
        ["kind", "x", 4, 50.0, 100.0],
    ]
    assert list(success.columns) == ["b", "a"]
    assert failure_table(pd.DataFrame(rows))["none"].tolist() == [5, 1]
