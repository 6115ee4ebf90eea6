"""Greedy evaluation on fixed tasks."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents import Config, make_learner
from agents.acting.evaluation import Evaluation
from agents.networks.actions import ActionDistribution
from agents.networks.agent import Agent
from agents.ppo.learner import Learner
from agents.runs.evaluator import Evaluator, default_sets
from helpers.tiny_policy import CONFIG, STEPS, food_next_to_agent, random_params
from helpers.trees import assert_same
from trap_tube_jax.registry import PAPER_TASK_SETS
from trap_tube_jax.scoring import Suite, suite
from trap_tube_jax.scoring.scores import Optimality
from trap_tube_jax.scoring.tasks import evaluation_tasks, fixed_tasks

Played = tuple[Evaluator, Any, dict[str, Evaluation]]


@pytest.fixture(scope="module")
def played() -> Played:
    """A random policy on two sets, and on tasks of which it solves some."""
    tasks = {name: evaluation_tasks(name, 2, 1) for name in ("base", "p")}
    tasks["mine"] = food_next_to_agent()
    evaluator = Evaluator(CONFIG, Suite(tasks, dict.fromkeys(tasks, STEPS)))
    params = random_params()
    return evaluator, params, evaluator(params)


def test_custom_tasks_are_scored(played):
    evaluator, _, outcomes = played
    assert outcomes["mine"].solved.any()
    assert 1 in outcomes["mine"].length[outcomes["mine"].solved]
    by_set = {score.set: score for score in evaluator.suite.scores(outcomes).sets}
    assert by_set["mine"].percent == 25 * outcomes["mine"].solved.sum()
    assert (by_set["mine"].interval is None, by_set["base"].interval is None) == (False, True)


def test_play_does_not_depend_on_the_size_of_blocks(played, monkeypatch):
    evaluator, params, outcomes = played
    monkeypatch.setattr(suite, "BLOCK", 3)
    assert_same(Evaluator(CONFIG, evaluator.suite)(params), outcomes)


def test_episodes_beyond_the_step_limit_of_their_set_are_not_solved(played):
    """With limits of 1 and 12, tasks that took longer than 1 are not solved."""
    evaluator, params, outcomes = played
    mine = outcomes["mine"]
    limits = {"one": 1, "twelve": STEPS}
    mine_twice: Any = dict.fromkeys(limits, evaluator.suite.tasks["mine"])
    found = Evaluator(CONFIG, Suite(mine_twice, limits))(params)
    np.testing.assert_array_equal(found["twelve"].solved, mine.solved)
    np.testing.assert_array_equal(found["twelve"].length, mine.length)
    at_once = mine.solved & (mine.length == 1)
    assert 0 < at_once.sum()
    np.testing.assert_array_equal(found["one"].solved, at_once)
    np.testing.assert_array_equal(found["one"].length, 1)


def test_a_limit_of_training_does_not_change_the_protocol(fresh_task_sets):
    tt.register("Own-v0", (), short="own", max_steps=6)
    for max_steps in (1, 500):
        evaluator = Evaluator.of_sets(Config(max_steps=max_steps), ["pst", "own"], 2)
        assert evaluator.suite.max_steps == {"pst": 50, "own": 6}


def test_tasks_have_the_feature_channels_that_the_policy_reads():
    evaluator = Evaluator.of_sets(Config(num_features=5), ["p"], 2)
    assert evaluator.suite.tasks["p"].palette.shape == (2, 8, 5)


def test_scores_use_the_papers_notation():
    outcome = Evaluation(jnp.array([True, False]), jnp.array([11, 50]), *[jnp.zeros((2, 50))] * 2)
    evaluator = Evaluator.of_sets(Config(), ["pst"], 2)
    (score,) = evaluator.suite.scores({"pst": outcome}, shortest={"pst": np.array([11, 12])}).sets
    assert (score.label, score.tasks, score.solved, score.percent) == ("{P, St}", 2, 1, 50.0)
    assert score.mean_steps == 11
    assert score.optimality == Optimality(2, 50.0, 1.0)


def test_a_custom_training_set_is_evaluated_after_the_papers(fresh_task_sets):
    tt.register("Own-v0", (), short="own")
    papers = tuple(entry.short for entry in PAPER_TASK_SETS)
    assert default_sets(Config(env_id="own")) == (*papers, "own")
    assert default_sets(Config(env_id="pst")) == papers


def test_values_are_of_the_extrinsic_head_before_each_step(monkeypatch):
    """The heads value a state by the steps taken so far, and by -7."""

    def count(agent, params, state, features, action_tm1, reward_tm1):
        return state + 1

    def policy_and_value(agent, params, state):
        time = state[:, :1]
        actions = ActionDistribution(jnp.zeros((len(state), 2, 4)))
        return actions, jnp.concatenate([time, jnp.full_like(time, -7.0)], axis=1)

    monkeypatch.setattr(Agent, "step", count)
    monkeypatch.setattr(Agent, "policy_and_value", policy_and_value)
    settings = {"curiosity": "effects", "value_heads": "separate", "bootstrap": "value"}
    config = Config.from_dict({**CONFIG.to_dict(), **settings})
    suite = Suite({"mine": food_next_to_agent()}, {"mine": STEPS})
    params = random_params(config)
    params["core"]["params"]["initial"] = jnp.zeros(config.hidden)
    found = Evaluator(config, suite)(params)["mine"].value
    np.testing.assert_array_equal(found, [range(1, STEPS + 1)] * 4)


def test_unknown_sets_are_refused():
    with pytest.raises(ValueError, match=r"unknown task set 'q'; allowed: .*pstsy"):
        Evaluator.of_sets(CONFIG, ["q"], 2)


def test_keys_of_tasks_are_never_drawn_in_training(monkeypatch):
    """Records the keys that transfers get, which depend only on the keys of `reset`."""
    seen = []
    no_update = lambda learner, state, *_: (state.params, state.opt_state, {})  # noqa: E731
    monkeypatch.setattr(Learner, "update", no_update)

    def record(key, state):
        data = jax.random.key_data(key)
        jax.debug.callback(lambda data: seen.append(tuple(np.ravel(data))), data)
        return state

    env = tt.Environment((record,), base=tt.base_state(1), max_steps=STEPS)
    config = Config.from_dict(
        {**CONFIG.to_dict(), "episodes_per_iteration": 4, "minibatch_size": 2}
    )
    learner = make_learner(config, env)
    seen.clear()
    first_key = jax.jit(lambda key: learner.init(key).key)
    shapes = jax.eval_shape(learner.init, jax.random.key(0))._replace(key=None)
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    iterate = jax.jit(learner.iterate)
    for seed in range(3):
        state = zeros._replace(key=first_key(jax.random.key(seed)))
        for _ in range(2):
            state, _ = iterate(state)
    jax.effects_barrier()
    training = set(seen)
    assert len(training) == 3 * 2 * 4

    seen.clear()
    for entry in PAPER_TASK_SETS:
        fixed_tasks(env, entry.id, 8)
        fixed_tasks(env, entry.id, 8, "validation")
    jax.effects_barrier()
    assert len(set(seen)) == 2 * 8 * len(PAPER_TASK_SETS)
    assert not training & set(seen)
