"""Scores by the benchmark's protocol: fixed tasks, and agents of any kind."""

import dataclasses
import json
import re
import zlib
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from helpers.refusal import assert_refused
from trap_tube_jax import registry
from trap_tube_jax.positions import layout_rows
from trap_tube_jax.scoring import Suite, suite
from trap_tube_jax.scoring.scores import Optimality
from trap_tube_jax.scoring.tasks import (
    ALL_SETS,
    PROTOCOL,
    evaluation_keys,
    evaluation_tasks,
    layout_numbers,
)

# Of the first 32 tasks of every set. Other tasks need another version of the protocol.
DIGESTS = {
    1: {
        "base": 1869258240, "p": 2439134681, "st": 592414579, "sy": 3888882155,
        "pst": 1365254835, "psy": 246488204, "stsy": 327823811, "pstsy": 3988046806,
    },
}  # fmt: skip
UP = 0
DOWN = 1
RIGHT = 3


class Rightward:
    """Grasps up and moves right, after `detour` moves; solves what lies to its right."""

    def __init__(self, *detour):
        self.moves = jnp.array([*detour, RIGHT])

    def initial(self, batch):
        return jnp.zeros(batch, jnp.int32)

    def act(self, observation, carry, key):
        del key
        assert observation.dtype == jnp.uint8
        move = self.moves[jnp.minimum(carry, len(self.moves) - 1)]
        return jnp.stack([jnp.full_like(move, UP), move], axis=1), carry + 1


class Random:
    def initial(self, batch):
        return ()

    def act(self, observation, carry, key):
        return jax.random.randint(key, (len(observation), 2), 0, 4), carry


class Single:
    """`Rightward` for one observation at a time; says how it was called."""

    predict = "always"  # no function, so `act` is called

    def __init__(self, action):
        self.action = action
        self.resets = 0
        self.seen = []

    def reset(self):
        self.resets += 1

    def act(self, state):
        self.seen.append(state)
        return self.action


class Recurrent:
    """As Stable-Baselines3 has it: grasps and moves by the number of steps since the start."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        assert deterministic
        assert observation.shape == (12, 12, 3)
        count = 0 if state is None else state
        return np.array([UP, RIGHT] if count else [UP, UP]), count + 1


@pytest.fixture(scope="module")
def near():
    """Three steps to the right of the agent, some of the time one below: a limit of 5 steps."""

    def food_near(key, state):
        row = jax.random.randint(key, (), 0, 2)
        return state.replace(food=state.agent + jnp.array([0, 3]) + jnp.stack([row, 0]))

    base = tt.base_state().replace(
        agent=jnp.array([1, 1], jnp.int32), food=jnp.array([1, 4], jnp.int32)
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "_task_sets", dict(registry._task_sets))
        yield tt.register("Near-v0", (food_near,), short="near", base=base, max_steps=5)


@pytest.fixture(scope="module")
def scores(near):
    return tt.score(Rightward(), ["Near-v0", "base"], tasks=20)


def rightward_food(tasks):
    return np.asarray(tasks.food[:, 0] == tasks.agent[:, 0])


@pytest.mark.parametrize("partitionable", [True, False])
@pytest.mark.parametrize("name", ALL_SETS)
def test_the_tasks_of_a_version_of_the_protocol_never_change(name, partitionable):
    with jax.threefry_partitionable(partitionable):
        tasks = evaluation_tasks(name, 32)
    parts = (tasks.board, tasks.palette, tasks.agent, tasks.tool, tasks.tool_extent, tasks.food)
    data = b"".join(np.asarray(part, np.uint8).tobytes() for part in parts)
    assert zlib.crc32(data) == DIGESTS[PROTOCOL][name]


def test_a_policy_is_scored_on_the_fixed_tasks(scores):
    solvable = rightward_food(evaluation_tasks("near", 20))
    assert 0 < solvable.sum() < 20
    assert [score.tasks for score in scores.sets] == [20, 1]
    assert scores["near"].solved == solvable.sum()
    assert scores["near"].percent == 5 * solvable.sum()
    assert scores["near"].mean_steps == 3
    assert (scores["base"].solved, scores["base"].interval) == (0, None)
    assert (scores["near"].interval, str(scores["near"].layouts)) == (None, "1 of 2")


@pytest.mark.parametrize(
    ("name", "rows", "numbers"),
    [
        ("own", [3, 1, 1, 3], [1, 0, 0, 1]),
        ("own", [7], [0]),
        ("own", [1, 2, 3], None),  # not counted as layouts
        ("own", [0, 1, 2, 3, 4, 4], [0, 1, 2, 3, 4, 4]),
        ("own", [0, 1, 2, 3, 4, 5, 5], None),
        ("p", [1, 1], None),
        ("p+st", [1, 1], None),
        ("own+p", [1, 1], None),
        ("st+sy", [1, 1], [0, 0]),
        ("sy", [0, 1, 2], [0, 1, 2]),
    ],
)
def test_a_set_has_few_layouts_if_its_tasks_repeat_five_or_fewer(name, rows, numbers):
    cells = jnp.stack([jnp.array(rows)] * 2, axis=1)
    tasks = jax.tree.map(lambda x: np.broadcast_to(x, (len(rows), *x.shape)), tt.base_state())
    layout = layout_numbers(name, tasks.replace(agent=cells))
    assert (None if layout is None else layout.tolist()) == numbers


def test_layouts_differ_by_every_part_but_colours():
    """And `layout_rows` by colours, but not by the position."""
    base = jax.tree.map(np.asarray, tt.base_state())
    parts = ("board", "agent", "tool", "tool_extent", "food")
    others = [base.replace(**{part: getattr(base, part) + 1}) for part in parts]
    recolored = base.replace(palette=base.palette[::-1])
    tasks = jax.tree.map(lambda *fields: np.stack(fields), base, recolored, *others)
    first, second, *rest = np.asarray(layout_numbers("sy", tasks)).tolist()
    assert first == second
    assert sorted([first, *rest]) == list(range(6))
    rows = np.asarray(jax.jit(layout_rows)(tasks))
    same = (rows == rows[0]).all(axis=1)
    alike = {"agent", "tool", "food"}
    assert same.tolist() == [True, False, *(part in alike for part in parts)]


def test_blocks_change_nothing_but_the_keys_of_draws(near, scores, monkeypatch):
    """Three blocks of five steps, of which none ends early."""
    monkeypatch.setattr(suite, "BLOCK", 8)
    assert tt.score(Rightward(), ["near"], tasks=20)["near"] == scores["near"]
    seen = []

    def record(data):
        seen.append(tuple(data.tolist()))

    class Recorder(Random):
        def act(self, observation, carry, key):
            jax.debug.callback(record, jax.random.key_data(key))
            return jnp.zeros((len(observation), 2), jnp.int32), carry

    assert tt.score(Recorder(), ["near"], tasks=20)["near"].solved == 0
    jax.effects_barrier()
    assert len(seen) == len(set(seen)) == 15


@pytest.mark.parametrize(("max_steps", "counts"), [(2, False), (3, True)])
def test_the_step_limit_of_the_task_set_holds(near, max_steps, counts):
    """Three steps lead to the food."""
    name = f"Near{max_steps}"
    tt.register(name, near.transfers, base=near.base, max_steps=max_steps)
    score = tt.score(Rightward(), [name], tasks=20)
    assert (score[name].solved > 0) == counts
    assert tt.score_gymnasium(Single((UP, RIGHT)), [name], tasks=20)[name] == score[name]


class Ends(NamedTuple):
    """Outcomes as the program of another agent may record them."""

    solved: jax.Array
    length: jax.Array
    food: jax.Array


def test_a_suite_plays_all_sets_in_equal_blocks_up_to_their_limits(near, monkeypatch):
    """The program solves every task in five steps; the limits are 5, 50, 3 and 50."""
    monkeypatch.setattr(suite, "BLOCK", 8)
    tt.register("Near3", near.transfers, base=near.base, max_steps=3)
    tasks = Suite.of_sets(["near", "{P}", "Near3", "base"], 6)
    assert tasks.longest == 50
    blocks = []

    def program(states):
        blocks.append(len(states.time))
        five = jnp.full(blocks[-1], 5)
        return Ends(five > 0, five, states.food)

    outcomes = tasks.play(program)
    assert blocks == [8, 8, 8], "of 19 tasks"
    for name, states in tasks.tasks.items():
        np.testing.assert_array_equal(outcomes[name].food, states.food)
    np.testing.assert_array_equal(outcomes["Near3"].length, 3)
    shortest = {name: np.array([2, 4, 1])[: len(x.time)] for name, x in tasks.tasks.items()}
    scores = tasks.scores(outcomes, shortest=shortest, seed=7)
    assert [(x.set, x.tasks, x.solved) for x in scores.sets] == [
        *[("near", 6, 6), ("p", 6, 6), ("Near3", 6, 0), ("base", 1, 1)]
    ]
    assert (scores["p"].mean_steps, scores.seed, scores.protocol) == (5, 7, PROTOCOL)
    found: Any = scores["p"].optimality
    assert dataclasses.astuple(found) == pytest.approx((3, 100, 7 / 15))
    assert_refused(["name at least one"], Suite.of_sets, [], 6)


def test_scores_are_records(scores):
    values = json.loads(json.dumps(scores.to_dict()))
    assert (values["protocol"], values["version"], values["seed"]) == (PROTOCOL, tt.__version__, 0)
    assert [score["set"] for score in values["sets"]] == ["near", "base"]
    assert {"tasks", "solved", "percent", "interval"} <= values["sets"][0].keys()
    lines = str(scores).splitlines()
    assert str(scores).isascii(), "any terminal shows it"
    assert lines[0].startswith("| set ")
    assert re.search(rf" {scores['near'].solved} \| +{scores['near'].percent:.1f} \|", lines[2])
    assert " 0 of 1 |" in lines[3]
    assert "layout counts as solved" in lines[-2]
    assert lines[-1] == f"Protocol {PROTOCOL}, trap-tube-jax {tt.__version__}."
    assert list(scores) == ["near", "base"]
    assert dict(scores) == {score.set: score for score in scores.sets}
    assert "TrapTube-v0" in scores
    assert "p" not in scores
    assert scores["TrapTube-v0"] is scores["base"]
    with pytest.raises(KeyError, match="no score of 'p'; allowed: near, base"):
        scores["p"]


def test_optimality_compares_solved_tasks_with_shortest_plans(near):
    """Two steps are lost on the detour. What is not in the agent's row is beyond 5 steps."""

    def far_if_below(key, state):
        state = near.transfers[0](key, state)
        is_below = state.food[0] > state.agent[0]
        return state.replace(food=state.food + jnp.stack([0, 3 * is_below]))

    tt.register("Far-v0", (far_if_below,), base=near.base, max_steps=5)
    near_ones = rightward_food(evaluation_tasks("Far-v0", 6)).sum()
    assert 0 < near_ones < 6
    score = tt.score(Rightward(UP, DOWN), ["Far-v0"], tasks=8, optimality=6)["Far-v0"]
    assert score.mean_steps == 5
    assert score.optimality == Optimality(near_ones, 100, 3 / 5)


def test_draws_depend_on_seed_and_set_alone(near):
    one: Any = np.int64(1)
    first, other = (tt.score(Random(), ["near"], 64, seed=seed) for seed in (0, one))
    assert json.loads(json.dumps(other.to_dict()))["seed"] == 1
    first = first["near"]
    assert first != other["near"]
    assert 0 < first.solved < 64
    assert tt.score(Random(), ["base", "near"], 64)["near"] == first


SAME = [(UP, RIGHT), np.array([UP, RIGHT]), 4 * UP + RIGHT, np.int64(4 * UP + RIGHT)]


@pytest.mark.parametrize("action", SAME)
def test_single_actions_of_either_kind_come_to_the_same(scores, action):
    agent = Single(action)
    single = tt.score_gymnasium(agent, ["near"], 20)
    assert single["near"] == scores["near"]
    assert single.seed is None
    assert agent.resets == 20
    tasks = evaluation_tasks("near", 20)
    np.testing.assert_array_equal(agent.seen[0], jax.vmap(tt.observe)(tasks)[0])


def test_an_agent_may_keep_a_state(near):
    """Its first step leads up, so it comes by the food one step later, and one row higher."""
    base = near.base.replace(food=near.base.food + jnp.array([-1, 0]))
    tt.register("Above-v0", (), base=base, max_steps=5)
    scores = tt.score_gymnasium(Recurrent(), ["near", "Above-v0"], 6)
    assert scores["near"].solved == 0
    assert scores["Above-v0"].mean_steps == 4


def test_a_model_trained_behind_vecnormalize_sees_normalised_observations(near, scores):
    """The task looks the same to both agents; one reads scaled observations."""

    class Normalizer:
        def normalize_obs(self, observation):
            return observation / np.float32(255)

    class Trained(Single):
        observation_space = np.zeros(3, np.float32)

        def get_vec_normalize_env(self):
            return Normalizer()

    plain = Single((UP, RIGHT))
    trained = Trained((UP, RIGHT))
    for agent in (plain, trained):
        assert tt.score_gymnasium(agent, ["near"], 3)["near"].tasks == 3
    np.testing.assert_allclose(trained.seen, np.asarray(plain.seen) / 255, rtol=1e-6)


def test_an_agent_that_cannot_be_scored_is_refused(near):
    words = ["num_features=5", "has 3"]  # before base, which an agent without action cannot play
    assert_refused(words, tt.score, Rightward(), ["near"], num_features=5)
    assert_refused(words, tt.score_gymnasium, Single(None), ["base", "near"], num_features=5)
    assert_refused(
        ["initial(batch)", "object has no initial", "score_gymnasium"], tt.score, object()
    )
    assert_refused(["predict(observation)", "neither"], tt.score_gymnasium, object())
    words = ["predict(observation)", "missing a required argument: 'carry'", "use tt.score"]
    assert_refused(words, tt.score_gymnasium, Rightward(), ["near"])

    class Floats(Single):
        observation_space = np.zeros(3, np.float32)  # all that is looked at is the dtype

    words = ["acts on float32", "uint8", "VecNormalize"]
    assert_refused(words, tt.score_gymnasium, Floats(0), ["near"])
    for sets, options, words in (
        (["q"], {}, ["unknown task set 'q'", "pstsy"]),
        ("sy", {}, ["sets must name task sets", "base, p", "'sy'"]),
        ((), {}, ["sets must name", "()"]),
        (["sy"], {"tasks": 0}, [">= 1", "0"]),
        (["sy"], {"tasks": 10**9}, ["evaluation tasks must be", "<= 1000000", "1000000000"]),
        (["sy"], {"optimality": -1}, ["optimality", ">= 0", "-1"]),
        *(
            (["sy"], {"seed": seed}, ["seed", ">= 0 and <= 4294967295", repr(seed)])
            for seed in (-1, 2**32, 1.5, True, None, "0")
        ),
    ):
        assert_refused(words, tt.score, Random(), sets, **options)
    words = ["purpose", "test, validation, confirmation", "'train'"]
    purpose: Any = "train"
    assert_refused(words, evaluation_tasks, "base", 1, purpose=purpose)
    assert_refused(words, evaluation_keys, "TrapTube-v0", 1, purpose)


@pytest.mark.parametrize(
    "action", [16, -1, (0, 4), (0, 1, 2), (0, 0, 0), (), 0.0, "up", None, ((0, 3), None)]
)
def test_single_actions_are_checked(action):
    words = ["(grasp, move)", "0 to 3", "0 to 15", repr(action)]
    assert_refused(words, tt.score_gymnasium, Single(action), ["base"])


class Constant:
    """Takes one action i32[2] three times, then others, i32[2] or i32[B, 2]."""

    def __init__(self, action, later=None):
        self.action = jnp.array(action)
        self.later = jnp.array(action if later is None else later)

    def initial(self, batch):
        return jnp.int32(0)

    def act(self, observation, carry, key):
        del key
        action = jnp.where(carry < 3, self.action, self.later)
        return jnp.broadcast_to(action, (len(observation), 2)), carry + 1


def test_act_must_return_a_carry(near):
    policy: Any = Random()
    policy.act = lambda observation, carry, key: jnp.zeros((len(observation), 2), int)
    words = ["act must return a pair (actions i32[B, 2], carry)", "got "]
    for tasks in (2, 3):
        assert_refused(words, tt.score, policy, ["near"], tasks)


def test_actions_of_numpy_are_refused_since_they_would_be_constant(near):
    policy: Any = Random()
    policy.act = lambda observation, carry, key: (np.zeros((len(observation), 2), int), carry)
    assert_refused(["must compute actions by JAX"], tt.score, policy, ["near"], 2)


def test_actions_of_a_batch_are_checked_until_their_episodes_are_over(near):
    over = rightward_food(evaluation_tasks("near", 20))[:, None]
    first = [UP, RIGHT]
    later = np.where(over, 9, RIGHT)
    assert tt.score(Constant(first, later), ["near"], 20)["near"].solved == over.sum()
    words = ["an invalid action", "(grasp, move)", "0 to 3"]
    for action in (Constant(first, np.where(over, RIGHT, 4)), Constant([-1, RIGHT])):
        assert_refused(words, tt.score, action, ["near"], 20)
    tt.register("Far-v0", (), base=near.base.replace(food=jnp.array([9, 9])), max_steps=4)
    assert_refused(words, tt.score, Constant([0, 0], [9, 9]), ["Far-v0"], 20)  # in the last step
    floats = Constant(np.array([0, 3], np.float32))
    assert_refused(["must hold integers", "float32[20, 2]"], tt.score, floats, ["near"], 20)
    flat: Any = Random()
    flat.act = lambda observation, carry, key: (jnp.zeros(len(observation), jnp.int32), carry)
    assert_refused(["integer[20, 2]", "int32[20]"], tt.score, flat, ["near"], 20)
