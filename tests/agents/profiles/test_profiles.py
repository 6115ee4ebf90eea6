"""Profiles: the oracle along hand-made episodes, what is made of them, and a tiny profile."""

import io
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

import trap_tube_jax as tt
from agents import profile as command
from agents.acting.policy import Policy
from agents.config import Config
from agents.experiments import figures as experiment_figures
from agents.networks.agent import Agent
from agents.profiles import figures, measure, mistakes, summary, tables
from agents.profiles.mistakes import (
    NEVER,
    NO_PUSH,
    Push,
    Turns,
    first_push,
    subgoals,
    turns,
    walks_to_food,
)
from agents.profiles.oracle import LOST, Oracle, replayed
from agents.profiles.tasks import STRENGTHS, kinds, points
from agents.runs.folder import write_json
from trap_tube_jax.controls import trap_and_exit_exchanged, trap_exchanged

UP, DOWN, LEFT, RIGHT = range(4)
# The shortest plan of the base task, in pairs of grasp and move.
PLAN = [(UP, UP), *[(UP, RIGHT)] * 6, (DOWN, RIGHT), *[(UP, UP)] * 3]
TINY = {
    "episodes": 4,
    "minibatch_size": 2,
    "epochs": 1,
    "max_steps": 6,
    "filters": (2, 2),
    "hidden": 4,
    "embedding": 2,
}


def episode(state, actions):
    """The state in NumPy arrays, the cells of agent, tool and food, and the actions."""
    actions = np.array(actions, np.int32)
    batch = jax.tree.map(lambda x: x[None], state)
    return jax.device_get(state), np.asarray(replayed(batch, actions[None]))[0], actions


def dead_end():
    """Food in a passage of exits; one push to the right, and nothing reaches it any more."""
    return tt.State.from_ascii(
        """
        ............
        ............
        ............
        ............
        .....11111..
        ..ATTeeee1..
        .....11111..
        ............
        ............
        ............
        ............
        ............
        """,
        food=(5, 5),
    )


def test_distances_along_the_shortest_plan_fall_to_zero():
    layout, cells, _ = episode(tt.base_state(), PLAN)
    distance = Oracle().along(layout, cells)
    assert distance.tolist() == list(range(11, -1, -1))
    assert turns(distance) == Turns(last_fell=11, first_rose=NEVER, lost=NEVER, nearest=11)


def test_distances_are_those_of_the_solver():
    """Also where a plan has told them before."""
    actions = [*PLAN[:5], (UP, LEFT), (DOWN, DOWN), (UP, UP), (UP, RIGHT)]
    layout, cells, _ = episode(tt.base_state(), actions)
    found = Oracle().along(layout, cells)
    for distance, (agent, tool, food) in zip(found, cells.astype(np.int32), strict=True):
        state = layout.replace(agent=agent, tool=tool, food=food)
        assert distance == tt.solve(state).length
    assert found.tolist() == [11, 10, 9, 8, 7, 6, 7, 8, 7, 6]
    assert turns(found) == Turns(last_fell=9, first_rose=6, lost=NEVER, nearest=5)


def test_food_is_lost_at_the_step_after_which_no_plan_helps():
    layout, cells, actions = episode(dead_end(), [(UP, UP), (UP, DOWN), *[(RIGHT, RIGHT)] * 2])
    distance = Oracle().along(layout, cells)
    assert distance.tolist() == [5, 4, 5, LOST, LOST]
    assert turns(distance) == Turns(last_fell=1, first_rose=2, lost=3, nearest=1)
    assert subgoals(layout, cells, actions) == (3, 3, 3, NEVER)


def test_an_episode_that_stands_still_never_turns():
    assert turns(np.array([7, 7, 7])) == Turns(NEVER, NEVER, NEVER, NEVER)


def test_subgoals_of_the_shortest_plan():
    layout, cells, actions = episode(tt.base_state(), PLAN)
    assert dict(zip(mistakes.SUBGOALS, subgoals(layout, cells, actions), strict=True)) == {
        "tool touched": 2,
        "tool moved": 2,
        "food moved": 5,
        "food out": 6,
    }


def test_subgoals_that_are_not_reached():
    layout, cells, actions = episode(tt.base_state(), [(UP, DOWN), (UP, UP), (UP, UP), (UP, UP)])
    assert subgoals(layout, cells, actions) == (4, 4, NEVER, NEVER)
    layout, cells, actions = episode(tt.base_state(), PLAN[:1])
    assert subgoals(layout, cells, actions) == (NEVER,) * 4


def test_a_tool_on_the_way_is_not_walked_through():
    """The food in the exit, with and without the tool before it."""
    state = tt.base_state()
    cells = np.array([[[9, 1], tool, [5, 7]] for tool in ([4, 1], [4, 8])], np.uint8)
    assert walks_to_food(
        np.asarray(state.board), np.asarray(state.tool_extent), cells
    ).tolist() == [
        True,
        False,
    ]


@pytest.mark.parametrize(
    ("state", "right"),
    [(tt.base_state(), True), (trap_exchanged()[0], False)],
    ids=["base", "twin"],
)
def test_the_same_push_is_right_in_one_task_of_a_pair(state, right):
    layout, cells, _ = episode(state, PLAN)
    assert first_push(Oracle(), layout, cells) == Push(RIGHT, right)


def test_without_a_push_there_is_no_right_one():
    layout, cells, _ = episode(tt.base_state(), PLAN[:4])
    assert first_push(Oracle(), layout, cells) == Push(NO_PUSH, False)


def test_twins_differ_in_trap_and_exit_alone():
    base = tt.base_state()
    twin = trap_and_exit_exchanged(base)
    jax.tree.map(np.testing.assert_array_equal, twin, trap_exchanged()[0])
    jax.tree.map(np.testing.assert_array_equal, trap_and_exit_exchanged(twin), base)


def test_points_draw_what_their_names_say():
    drawn = points(("colours", "pairs"), (0.5,), 3, 3)
    base = tt.base_state()
    assert [name for name in drawn if drawn[name].axis == "colours"] == ["colours 0.5", "colours 1"]
    assert {len(point.tasks.time) for point in drawn.values() if point.axis == "layout"} == {3}
    same = {
        name: np.all(np.asarray(point.tasks.palette) == np.asarray(base.palette))
        for name, point in drawn.items()
    }
    assert [same[name] for name in ("layout 1", "control far-exit", "colours 0.5")] == [1, 1, 0]
    for name in ("board", "agent", "tool", "food"):
        one, two = (getattr(drawn[point].tasks, name) for point in ("layout 1", "both 1"))
        np.testing.assert_array_equal(one, two)
    twins = drawn["both 1, exchanged"].tasks
    np.testing.assert_array_equal(twins.palette, drawn["both 1"].tasks.palette)
    assert len([name for name in drawn if name.startswith("control ")]) == 13


@pytest.mark.parametrize(
    ("agent", "extent", "exchanged", "kind"),
    [
        ((9, 1), (4, 1), False, "away, across"),  # the base task: the food leaves to the right
        ((11, 5), (4, 1), False, "sideways, across"),
        ((5, 1), (1, 4), False, "away, along"),
        ((7, 11), (1, 4), False, "towards, along"),
        ((7, 11), (1, 4), True, "away, along"),
    ],
)
def test_kinds_of_tasks(agent, extent, exchanged, kind):
    state = tt.base_state().replace(agent=jnp.array(agent), tool_extent=jnp.array(extent))
    state = trap_and_exit_exchanged(state) if exchanged else state
    assert kinds(jax.tree.map(lambda x: x[None], state)) == [kind]


@pytest.mark.parametrize(
    ("parts", "strengths", "message"),
    [
        (("colour",), STRENGTHS, "unknown parts .*allowed: one or more of colours, layout"),
        ((), STRENGTHS, "allowed: one or more of"),
        (("colours",), (0.0,), "strengths must be above 0"),
        (("layout",), (1.5,), "strength must be a number from 0 to 1"),
    ],
)
def test_what_is_not_allowed_is_named(parts, strengths, message):
    with pytest.raises(ValueError, match=message):
        points(parts, strengths, 2, 3)


def test_counts_of_a_record_made_by_hand():
    """Five episodes: shortest way, detour, tool touched, food lost, and one without a plan."""
    columns = {
        "task": [1, 2, 3],
        "last_fell": [12, 4, 9],
        "first_rose": [3, 5, 2],
        "lost": [NEVER, NEVER, 10],
        "nearest": [12, 4, 9],
        "tool touched": [1, 4, 1],
        "tool moved": [2, NEVER, 2],
        "food moved": [5, NEVER, 3],
        "food out": [9, NEVER, NEVER],
    }
    policy = {
        "name": "mine",
        "config": {"max_steps": 50},
        "steps": {"layout 1": [10, 12, 0, 0, 0]},
        "mistakes": {"layout 1": columns},
        "pushes": {
            "a": {"direction": [3, 3, -1, 2], "right": [True, True, False, False]},
            "b": {"direction": [2, 3, 2, 3], "right": [True, False, True, False]},
        },
    }
    record = {
        "settings": {"episodes": 5},
        "points": {
            "layout 1": {
                "axis": "layout",
                "value": 1.0,
                "shortest": [10, 8, 14, 11, -1],
                "kinds": ["away, along", "towards, along", *["towards, across"] * 3],
            }
        },
        "pairs": {"{P}": ["a", "b"]},
        "policies": [policy],
    }
    assert summary.outcomes(record, policy, "layout 1") == {
        "shortest way": 1,
        "detour": 1,
        "food out": 0,
        "food moved": 0,
        "tool moved": 0,
        "tool touched": 1,
        "tool not touched": 0,
        "food lost": 1,
    }
    assert summary.stage(summary.mistakes(policy, "layout 1")[0], 3) == "tool moved"
    assert list(summary.pair_counts(record, policy, "{P}").values()) == [1, 1, 1, 1]
    (row,) = tables.pairs_table(record).rows
    assert row == ("{P}", "mine", "4", *["25.0"] * 4)
    by_length = summary.by_length(record, policy)
    assert {length: each.tasks for length, each in by_length.items()} == {8.0: 1, 35 / 3: 3}
    by_kind = summary.by_kind(record, policy)
    assert {kind: (each.tasks, each.percent) for kind, each in by_kind.items()} == {
        "away, along": (1, 100.0),
        "towards, across": (3, 0.0),
        "towards, along": (1, 100.0),
    }
    outcome = summary.outcome(record, policy, "layout 1")
    assert (outcome.tasks, outcome.percent) == (5, 40.0)
    assert outcome.optimality is not None
    assert outcome.optimality.mean == pytest.approx((1 + 8 / 12) / 2)
    table = tables.mistakes_table(record, policy).to_markdown()
    assert "| failed: tool touched | 1 |" in table
    assert "| failed ones, distance first rose: median step | 4 |" in table
    assert "| detours, tool moved: median step | 2 |" in table
    assert "| detours, begun after: tool moved | 1 |" in table


def profile_at_random(**settings):
    """The record of a random policy."""
    config = Config(**{**TINY, **settings.pop("config", {})})
    shapes = jax.eval_shape(Agent(config).init, jax.random.key(0))
    rng = np.random.default_rng(0)
    params = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), x.dtype), shapes)
    policies = {"mine": Policy("mine", config, params, 7)}
    chosen = measure.Settings(strengths=(1.0,), tasks=2, **settings)
    return measure.profile(policies, chosen, Console(file=io.StringIO()), command="x")


@pytest.fixture(scope="module")
def tiny():
    return profile_at_random(episodes_per_iteration=2)


def test_a_policy_without_a_step_limit_plays_as_long_as_the_base_task():
    record = profile_at_random(
        config={"max_steps": None}, parts=("colours",), episodes_per_iteration=0
    )
    assert record["policies"][0]["config"]["max_steps"] == 50
    assert set(record["policies"][0]["steps"]) == {"base", "colours 1"}


def test_a_profile_from_end_to_end(tiny, tmp_path, capsys):
    path = tmp_path / "mine.json"
    write_json(path, tiny)
    command.main(["--draw", str(path), "--out", str(tmp_path / "out")])
    shown = capsys.readouterr().out
    assert "Controls" in shown
    assert "What mine fails at" in shown
    files = {each.name for each in (tmp_path / "out").iterdir()}
    assert files == {"profile.json", "tables.md", "profile.png", "profile_mine.png"}
    for file in ("profile.png", "profile_mine.png"):
        drawn_from = experiment_figures.drawn_from(tmp_path / "out" / file)
        assert drawn_from == figures.digest(tiny)
    text = (tmp_path / "out" / "tables.md").read_text()
    assert "| trap-turned | 11 |" in text
    assert "| {P, St} | mine | 2 |" in text


def test_a_recorded_command_names_no_place_of_results():
    given = "runs/mine --out there --record=a.json --tasks 5 --record b.json --parts swaps"
    kept = ["runs/mine", "--tasks", "5", "--parts", "swaps"]
    assert command.without_places(given.split()) == kept


def test_a_profile_holds_every_episode(tiny):
    (policy,) = tiny["policies"]
    for name, point in tiny["points"].items():
        assert len(policy["steps"][name]) == len(point["shortest"])
        assert max(policy["steps"][name]) <= TINY["max_steps"]
    swaps = [point["shortest"] for point in tiny["points"].values() if point["axis"] == "swap"]
    assert swaps == [[10], [8], [10], [16]]  # environment.md, "Task sets"
    assert tiny["points"]["base"]["shortest"] == [11]
    assert tiny["points"]["control too-short-tool"]["shortest"] == [-1]
    # No plan of a {P} task is as short as the step limit of this policy.
    assert policy["mistakes"]["layout 1"]["task"] == []
    assert tiny["machines"][0]["commit"]


def test_records_of_profiles_name_a_commit_known_before_measuring(tmp_path, monkeypatch, capsys):
    arguments = ["--pretrained", "fast-base", "--parts", "swaps"]
    arguments += ["--out", str(tmp_path / "out"), "--record", str(tmp_path / "x.json")]
    monkeypatch.setattr(command, "profile", None)
    for commit, message in (("abc-dirty", "this one of abc-dirty"), (None, "give --commit")):
        monkeypatch.setattr(
            "agents.experiments.records.machine", lambda commit=commit: {"commit": commit}
        )
        with pytest.raises(SystemExit):
            command.main(arguments)
        assert message in capsys.readouterr().err

    def profile(policies, settings, console, *, commit, **known):
        raise ValueError(f"measures, of commit {commit}")

    monkeypatch.setattr(command, "profile", profile)
    with pytest.raises(SystemExit):
        command.main([*arguments, "--commit", "abc"])
    assert "measures, of commit abc" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give runs' folders or --pretrained NAME"),
        (["--pretrained", "none"], "unknown agent 'none'; allowed: best-pstsy"),
        (
            ["--pretrained", "fast-base", "fast-base"],
            "tell them apart: fast-base, fast-base; rename one",
        ),
        (["--pretrained", "fast-base", "--import", "no.such"], "no.such"),
        (["--pretrained", "fast-base", "--tasks", "0"], "tasks must be >= 1, got 0"),
        (["--draw", "none.json"], "is no record"),
    ],
)
def test_the_command_line_refuses(arguments, message, capsys, tmp_path):
    with pytest.raises(SystemExit):
        command.main([*arguments, "--out", str(tmp_path / "out")])
    assert message in capsys.readouterr().err
    assert not pathlib.Path(tmp_path / "out").exists()
