"""Greedy evaluation: fixed tasks, scores, tables and the page of a run."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents import make_train
from agents.acting.evaluation import Evaluation, Evaluator
from agents.config import Config
from agents.networks.agent import Agent
from agents.ppo.learner import Learner
from trap_tube_jax.registry import PAPER_TASK_SETS
from trap_tube_jax.scoring import benchmark
from trap_tube_jax.scoring.scores import Layouts, Optimality, Score, wilson_interval
from trap_tube_jax.scoring.tasks import (
    evaluation_keys,
    evaluation_tasks,
    fixed_tasks,
    layout_numbers,
)

TINY = {
    "episodes_per_iteration": 4,
    "minibatch_size": 2,
    "epochs": 1,
    "max_steps": 6,
    "filters": (2, 2),
    "hidden": 4,
    "embedding": 2,
    "encode_chunk_size": 3,
}
SHORTS = [entry.short for entry in PAPER_TASK_SETS]
# The food beside the agent, on each side in turn: whichever way the first move of a policy
# leads, it solves one of them.
FOOD_BESIDE = [(8, 1), (10, 1), (9, 0), (9, 2)]


def stack(states):
    return jax.tree.map(lambda *x: jnp.stack(x), *states)


def assert_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def food_beside_agent(num_features):
    base = tt.base_state(num_features)
    return stack([base.replace(food=jnp.array(cell, jnp.int32)) for cell in FOOD_BESIDE])


def zeros_like(tree):
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), tree)


def random_params(config):
    """Parameters without the seconds that compiling their initialisers takes."""
    shapes = jax.eval_shape(Agent(config).init, jax.random.key(0))
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), x.dtype), shapes)


@pytest.fixture(scope="module")
def grey_play():
    """A random policy on grey boards: every set's tasks, and an own set of known outcome."""
    config = Config(**TINY, num_features=1)
    tasks = {name: evaluation_tasks(name, 2, 1) for name in ("base", "p")}
    evaluator = Evaluator(config, {**tasks, "mine": food_beside_agent(1)})
    params = random_params(config)
    return evaluator, params, evaluator(params)


@pytest.mark.parametrize("name", SHORTS)
def test_tasks_are_the_same_at_every_call(name):
    tasks = evaluation_tasks(name, 3)
    assert_equal(tasks, evaluation_tasks(tt.task_set(name).id, 3))
    assert len(tasks.time) == (1 if name == "base" else 3)


def test_tasks_are_those_that_the_environment_draws():
    keys = evaluation_keys("PerceptualSymbolicTrapTube-v0", 3)
    drawn, _ = jax.jit(jax.vmap(tt.make("psy").reset))(keys)
    assert_equal(evaluation_tasks("psy", 3), drawn)


def test_more_tasks_begin_with_the_same_ones():
    few, many = evaluation_tasks("sy", 3), evaluation_tasks("sy", 5)
    assert_equal(few, jax.tree.map(lambda x: x[:3], many))


def test_keys_differ_within_and_between_sets_and_purposes():
    keys = [
        jax.random.key_data(evaluation_keys(entry.id, 64, purpose))
        for entry in PAPER_TASK_SETS
        for purpose in ("test", "validation")
    ]
    assert len(np.unique(np.concatenate(keys), axis=0)) == 64 * len(keys)


def test_keys_of_tasks_are_never_drawn_in_training(monkeypatch):
    """Playing with recorded keys: what a transfer gets is fixed by what `reset` gets."""
    seen = []
    nothing_learnt = lambda learner, state, *_: (state.params, state.opt_state, {})  # noqa: E731
    monkeypatch.setattr(Learner, "optimize", nothing_learnt)

    def record(key, state):
        data = jax.random.key_data(key)
        jax.debug.callback(lambda data: seen.append(tuple(np.ravel(data))), data)
        return state

    env = tt.Environment((record,), max_steps=6)
    config = Config(**TINY, curiosity="none")
    train = make_train(config, env)
    seen.clear()
    first_key = jax.jit(lambda key: train.init(key).key)
    zeros = zeros_like(jax.eval_shape(train.init, jax.random.key(0))._replace(key=None))
    iterate = jax.jit(train.iterate)
    for seed in range(3):
        state = zeros._replace(key=first_key(jax.random.key(seed)))
        for _ in range(2):
            state, _ = iterate(state)
    jax.effects_barrier()
    training = set(seen)
    assert len(training) == 3 * 2 * config.episodes_per_iteration

    seen.clear()
    for entry in PAPER_TASK_SETS:
        fixed_tasks(env, entry.id, 8)
        fixed_tasks(env, entry.id, 8, "validation")
    jax.effects_barrier()
    assert len(set(seen)) == 2 * 8 * len(PAPER_TASK_SETS)
    assert not training & set(seen)


def test_outcomes_are_those_of_the_recorded_actions(grey_play):
    evaluator, _, played = grey_play
    step = jax.jit(tt.Environment(base=tt.base_state(1), max_steps=6).step)
    for name, tasks in evaluator.tasks.items():
        for index, solved in enumerate(played[name].solved):
            state = jax.tree.map(lambda x, index=index: x[index], tasks)
            actions = played[name].action[index, : played[name].length[index]]
            for action in actions:
                assert not state.terminated
                state, _ = step(state, jnp.asarray(action))
            assert state.terminated == solved
            assert state.terminated | state.truncated


def test_own_tasks_are_evaluated(grey_play):
    evaluator, _, played = grey_play
    outcome = played["mine"]
    assert outcome.solved.any()
    assert 1 in outcome.length[outcome.solved]
    assert not played["base"].solved.any()  # needs 11 steps, has 6
    by_set = {score.set: score for score in evaluator.scores(played)}
    assert by_set["mine"].percent == 25 * outcome.solved.sum()
    assert by_set["mine"].interval is not None
    assert by_set["base"].interval is None
    assert by_set["base"].mean_steps is None


def test_blocks_change_nothing(grey_play, monkeypatch):
    evaluator, params, played = grey_play
    monkeypatch.setattr(benchmark, "BLOCK", 3)
    blocks = Evaluator(Config(**TINY, num_features=1), evaluator.tasks)
    assert_equal(blocks(params), played)


def test_each_set_has_its_own_limit_where_the_settings_leave_it(grey_play, own_task_sets):
    """With a limit of 6 for both, and with 1 and 6: what took longer than 1 is not solved."""
    evaluator, params, played = grey_play
    for name, limit in (("one", 1), ("six", 6)):
        tt.register(name, (), base=tt.base_state(1), max_steps=limit)
    tasks: dict[str, tt.State] = dict.fromkeys(("one", "six"), evaluator.tasks["mine"])
    config = Config(**{**TINY, "max_steps": None}, num_features=1)
    own = Evaluator(config, tasks)
    assert own.limits == {"one": 1, "six": 6}
    outcome = own(params)
    for name in ("solved", "length"):
        found, expected = (getattr(each, name) for each in (outcome["six"], played["mine"]))
        np.testing.assert_array_equal(found, expected)
    at_once = played["mine"].solved & (played["mine"].length == 1)
    assert 0 < at_once.sum()
    np.testing.assert_array_equal(outcome["one"].solved, at_once)
    np.testing.assert_array_equal(outcome["one"].length, 1)
    assert Evaluator(Config(**TINY, num_features=1), tasks).limits == {"one": 6, "six": 6}
    with pytest.raises(ValueError, match="unknown task set 'mine'"):
        Evaluator(config, {"mine": tasks["one"]})


def test_optimality_compares_with_shortest_plans():
    found = Optimality.of(
        solved=np.array([True, True, False, False, False]),
        length=np.array([10, 20, 50, 50, 50]),
        shortest=np.array([10, 5, -1, 51, 50]),
        max_steps=50,
    )
    assert found.solvable == 3
    assert found.percent_of_solvable == pytest.approx(200 / 3)
    assert (found.mean, found.worst) == (0.625, 0.25)
    nothing = Optimality.of(np.array([False]), np.array([50]), np.array([-1]), 50)
    assert nothing == Optimality(0, None, None, None)


def test_scores_use_the_paper_notation():
    outcome = Evaluation(jnp.array([True, False]), jnp.array([11, 50]), *[jnp.zeros((2, 50))] * 2)
    evaluator = Evaluator.of_sets(Config(), ["pst"], 2)
    (score,) = evaluator.scores({"pst": outcome}, {"pst": np.array([11, 12])})
    assert (score.label, score.tasks, score.solved, score.percent) == ("{P, St}", 2, 1, 50.0)
    assert score.mean_steps == 11
    assert score.optimality == Optimality(2, 50.0, 1.0, 1.0)


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    # R: binom::binom.confint(successes, trials, methods = "wilson").
    [(0, 10, 0.0, 0.27753), (5, 10, 0.23659, 0.76341), (10, 10, 0.72247, 1.0)],
)
def test_wilson_interval(successes, trials, low, high):
    np.testing.assert_allclose(wilson_interval(successes, trials), (low, high), atol=1e-5)


@pytest.mark.parametrize(("successes", "trials"), [(1, 0), (-1, 5), (6, 5)])
def test_wilson_interval_refuses(successes, trials):
    with pytest.raises(ValueError, match=r"\b(k|n)\b"):
        wilson_interval(successes, trials)


@pytest.mark.parametrize("name", SHORTS)
def test_sets_with_few_layouts_are_named(name):
    layout = layout_numbers(name, evaluation_tasks(name, 64))
    number = {"base": 1, "st": 1, "sy": 5, "stsy": 5}.get(name)
    assert (None if layout is None else len(set(layout.tolist()))) == number


def test_few_layouts_are_counted_and_have_no_interval():
    solved = np.array([True, True, False, True, False])
    layout = np.array([0, 0, 0, 1, 1])
    score = Score.of("stsy", "{St, Sy}", solved, np.full(5, 9), layout=layout)
    assert (score.percent, score.interval, score.layouts) == (60.0, None, Layouts(1, 2))
    assert str(score.layouts) == "1 of 2"
    assert Score.of("p", "{P}", solved, np.full(5, 9)).layouts is None


def test_refusals():
    config = Config(**TINY)
    with pytest.raises(ValueError, match=r"unknown task set 'q'; allowed: .*pstsy"):
        Evaluator.of_sets(config, ["q"], 2)
    with pytest.raises(ValueError, match="name at least one task set; allowed: base, p"):
        Evaluator.of_sets(config, [], 2)
    with pytest.raises(ValueError, match="must be an integer >= 1, got 0"):
        evaluation_tasks("p", 0)
