"""Trained policies act from observations alone, alike in every way of calling them."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import agents
import trap_tube_jax as tt
from agents import Config, Policy, evaluate
from agents.acting.evaluation import Evaluator
from agents.acting.policy_files import save_policy
from agents.networks.agent import Agent
from agents.runs.checkpoint import Checkpoints
from agents.runs.folder import Run, RunFolder
from trap_tube_jax.scoring.tasks import evaluation_tasks

STEPS = 12
CONFIG = Config(
    env_id="SymbolicTrapTube-v0",
    num_features=1,
    max_steps=STEPS,
    filters=(2, 2),
    hidden=4,
    embedding=2,
    curiosity="none",
)
SEEDS = (3, 4)
# The food beside the agent, on each side in turn: every policy solves some of these tasks.
FOOD_BESIDE = [(8, 1), (10, 1), (9, 0), (9, 2)]


def random_params(seed):
    shapes = jax.eval_shape(Agent(CONFIG).init, jax.random.key(0))
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), x.dtype), shapes)


def make_tasks():
    base = tt.base_state(1)
    states = [base.replace(food=jnp.array(cell, jnp.int32)) for cell in FOOD_BESIDE]
    return jax.tree.map(lambda *x: jnp.stack(x), *states)


def drive(policy, tasks):
    """Plays with nothing but observations, as a user would; returns solved, length, actions."""
    env = tt.Environment(base=tt.base_state(1), max_steps=STEPS)
    step, act = jax.jit(jax.vmap(env.step)), jax.jit(policy.act)
    state, carry = tasks, policy.initial(len(tasks.time))
    observation = jax.vmap(tt.observe)(state)
    batch = len(tasks.time)
    solved, length, actions = np.zeros(batch, bool), np.zeros(batch, int), []
    for time in range(STEPS):
        action, carry = act(observation, carry, jax.random.key(time))
        length += ~np.asarray(state.terminated | state.truncated)
        state, timestep = step(state, action)
        observation = timestep.observation
        solved |= np.asarray(timestep.reward) > 0
        actions.append(np.asarray(action))
    return solved, length, np.stack(actions, axis=1)


@pytest.fixture(scope="module")
def run_path(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "mine"
    folder = RunFolder.create(path, Run(CONFIG, seed=SEEDS[0], seeds=2))
    both = jax.tree.map(lambda *x: jnp.stack(x), *map(random_params, SEEDS))
    with Checkpoints(folder.checkpoints, keep=1) as checkpoints:
        checkpoints.save(6, {"params": both, "iteration": jnp.full(2, 6)}, {})
    return path


def test_a_policy_that_faces_the_food_reaches_them_too():
    """From observations alone it finds the frame that the evaluator finds."""
    config = dataclasses.replace(CONFIG, align_to_food=True)
    policy, tasks = Policy("x", config, random_params(SEEDS[1]), 1), make_tasks()
    solved, length, actions = drive(policy, tasks)
    played = Evaluator(config, {"mine": tasks})(policy.params)["mine"]
    np.testing.assert_array_equal(solved, played.solved)
    np.testing.assert_array_equal(length, played.length)
    for index, count in enumerate(length):
        np.testing.assert_array_equal(actions[index, :count], played.action[index, :count])
    # On the board as it is the same parameters act otherwise.
    plain = policy._replace(config=CONFIG)
    assert not np.array_equal(actions, drive(plain, tasks)[2])


@pytest.mark.parametrize("seed", SEEDS)
def test_a_loaded_policy_reaches_the_evaluators_outcomes(run_path, seed):
    policy = agents.load(run_path, seed=seed)
    tasks = make_tasks()
    solved, length, actions = drive(policy, tasks)
    played = Evaluator(CONFIG, {"mine": tasks})(policy.params)["mine"]
    np.testing.assert_array_equal(solved, played.solved)
    np.testing.assert_array_equal(length, played.length)
    assert solved.any()
    assert length.max() > 1  # the recurrent state matters
    for index, count in enumerate(length):
        np.testing.assert_array_equal(actions[index, :count], played.action[index, :count])


def test_driving_scoring_and_evaluating_come_to_the_same(run_path, tmp_path, own_task_sets):
    """On the fixed tasks of a registered set."""

    def food_beside(key, state):
        cells = jnp.array(FOOD_BESIDE, jnp.int32)
        return state.replace(food=cells[jax.random.randint(key, (), 0, 4)])

    base = tt.base_state(1)
    tt.register("Beside-v0", (food_beside,), base=base, max_steps=STEPS)
    arguments = [str(run_path), "--sets", "Beside-v0", "--tasks", "8"]
    evaluate.main([*arguments, "--json", str(tmp_path / "table.json")])
    _, second = json.loads((tmp_path / "table.json").read_text())
    (found,) = second["sets"]
    assert 0 < found["percent"] < 100
    policy = agents.load(run_path, seed=SEEDS[1])
    solved, length, _ = drive(policy, evaluation_tasks("Beside-v0", 8))
    assert found["percent"] == 100 * solved.mean()
    scored = tt.score(policy, ["Beside-v0"], tasks=8)["Beside-v0"]
    assert dataclasses.asdict(scored)["mean_steps"] == found["mean_steps"] == length[solved].mean()
    assert scored.percent == found["percent"]


def test_runs_files_and_names_are_loaded(run_path, tmp_path):
    first = agents.load(str(run_path))
    assert (first.name, first.iteration, first.greedy) == ("seed 3", 6, True)
    save_policy(tmp_path / "x.safetensors", first)
    again = agents.load(tmp_path / "x.safetensors")
    jax.tree.map(np.testing.assert_array_equal, again.params, first.params)
    assert agents.load("fast-base").config.env_id == "TrapTube-v0"


def test_a_policy_may_draw_its_actions(run_path):
    policy = agents.load(run_path, greedy=False)
    observation = jax.vmap(tt.observe)(make_tasks())
    draw = jax.jit(lambda key: policy.act(observation, policy.initial(4), key)[0])
    drawn = np.stack([draw(jax.random.key(seed)) for seed in range(8)])
    assert len(np.unique(drawn.reshape(8, -1), axis=0)) > 1
    np.testing.assert_array_equal(draw(jax.random.key(0)), drawn[0])
    greedy = policy._replace(greedy=True)
    for key in (None, jax.random.key(0), jax.random.key(1)):
        action, _ = greedy.act(observation, greedy.initial(4), key)
        np.testing.assert_array_equal(action, greedy.act(observation, greedy.initial(4))[0])


def test_impossible_requests_are_refused(run_path, tmp_path):
    policy = Policy("x", CONFIG, random_params(0), 1, greedy=False)
    observation = jax.vmap(tt.observe)(make_tasks())
    with pytest.raises(ValueError, match=r"must be uint8\[3, 12, 12, 1\], got uint8\[4, 12, 12, 1"):
        policy.act(observation, policy.initial(3), jax.random.key(0))
    with pytest.raises(ValueError, match=r"got float32\[4, 12, 12, 1\]"):
        policy.act(observation / 255, policy.initial(4), jax.random.key(0))
    with pytest.raises(ValueError, match="a policy that draws its actions needs a key"):
        policy.act(observation, policy.initial(4))
    with pytest.raises(ValueError, match=r"mine has no seed 5; allowed: 3, 4"):
        agents.load(run_path, seed=5)
    with pytest.raises(
        ValueError, match=r"none holds no run; runs in .*; shipped parameters: base"
    ):
        agents.load(tmp_path / "none")
    with pytest.raises(ValueError, match="of a run: base is not a run"):
        agents.load("fast-base", iteration=5)
    with pytest.raises(ValueError, match="base has no seed 0; allowed: none"):
        agents.load("fast-base", seed=0)
