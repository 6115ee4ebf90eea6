"""One iteration of training: tasks, weights of rewards, gradient steps, settings it refuses.

Play and gradient steps are replaced where they are not tested.
"""

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import trap_tube_jax as tt
from agents import Config, make_learner
from agents.acting.encoding import Encoding
from agents.acting.episodes import Episodes
from agents.acting.rollout import Trajectory
from agents.acting.symmetry import Symmetry
from agents.arrays import to_arrays
from agents.config import PRESETS
from agents.curiosity import Experience
from agents.ppo import advantages, learner
from agents.ppo.learner import Learner, TrainState
from helpers.curiosities import Returning
from helpers.small_runs import SETTINGS
from helpers.trees import assert_same, rows
from trap_tube_jax.objects import AGENT
from trap_tube_jax.transfers import Mixture

BEST = Config.preset(
    "best",
    **{**SETTINGS, "epochs": 3},
    iterations=10,
    replay_capacity=5,
    replay_fractions=(0.25, 0.25),
    max_transitions=None,
    intrinsic_anneal_fraction=0.8,
)
PLAIN = Config(**{**SETTINGS, "episodes_per_iteration": 2, "minibatch_size": 2}, curiosity="none")
STEPS = 6
EPISODES = 8
OWN_COLORS = tt.Environment(base=tt.base_state().replace(palette=255 - tt.base_state().palette))


def recolour(key: jax.Array, state: tt.State) -> tt.State:
    """Draws a colour for the agent."""
    color = jax.random.randint(key, (3,), 0, 256).astype(jnp.uint8)
    return state.replace(palette=state.palette.at[AGENT].set(color))


def recolour_rarely(key: jax.Array, state: tt.State) -> tt.State:
    """Draws a colour for the agent in 5 % of tasks."""
    chosen = jax.random.bernoulli(key, 0.05)
    color = jnp.where(chosen, 7, state.palette[AGENT])
    return state.replace(palette=state.palette.at[AGENT].set(color))


MIXED = Mixture((tt.perceptual, tt.compose(recolour)), (1, 1))
SOLVED = np.array([True, False, False, False, False, True, True, True])  # 4 new, 2, 2


def plus_one(tree: Any) -> Any:
    return jax.tree.map(lambda x: x + jnp.ones((), x.dtype), tree)


class Scripted(Learner):
    """Plays tasks of known keys, solves those of `SOLVED`, and adds 1 to all that is learned."""

    def draw_tasks(self, task_replay, key):
        return reset_keys()

    def play(self, params, reset_keys, action_key):
        del params, action_key
        shape = (len(reset_keys), STEPS)
        reward = jnp.zeros(shape).at[:, -1].set(SOLVED)
        episodes = Episodes(
            layout=jax.tree.map(lambda x: jnp.stack([x] * EPISODES), tt.base_state()),
            cells=jnp.zeros((EPISODES, STEPS + 1, 3, 2), jnp.uint8),
            action=jnp.zeros((*shape, 2), jnp.int32),
            reward=reward,
            discount=1 - reward,
            mask=jnp.ones(shape),
        )
        value = jax.random.normal(
            jax.random.key(3), (EPISODES, STEPS + 1, self.config.num_value_heads)
        )
        symmetry = Symmetry.from_index(jnp.zeros(len(reset_keys), jnp.int32))
        return Trajectory(symmetry, episodes, jnp.zeros(shape), value)

    def intrinsic_reward(self, state, trajectory):
        return jax.random.uniform(jax.random.key(4), (EPISODES, STEPS)), plus_one(state.memory)

    def update(self, state, batch, key):
        metrics = {"advantage": batch.advantage}
        return plus_one(state.params), plus_one(state.opt_state), metrics


def reset_keys() -> jax.Array:
    return jax.random.split(jax.random.key(5), EPISODES)


def data(keys: jax.Array) -> list[tuple[int, ...]]:
    """Keys as numbers, to compare."""
    return [tuple(key) for key in np.asarray(jax.random.key_data(keys.reshape(-1)))]


@pytest.fixture(scope="module")
def scripted() -> tuple[Learner, TrainState, Any]:
    """A scripted learner, its first state, and its iteration, compiled; keys may be used again."""
    scripted = Scripted(**vars(make_learner(BEST)))

    def iterate(state):
        replay = state.task_replay._replace(keys=jax.random.clone(state.task_replay.keys))
        return scripted.iterate(state._replace(key=jax.random.clone(state.key), task_replay=replay))

    return scripted, scripted.init(jax.random.key(0)), jax.jit(iterate)


def by_plain_path(config: Config) -> Learner:
    """Makes a learner that compiles sooner than one of the fast path."""
    made = make_learner(config)
    return dataclasses.replace(made, encoding=Encoding(made.agent, made.curiosity.encode))


def test_replayed_tasks_are_of_their_list_and_the_others_new():
    best = make_learner(BEST)
    task_replay = best.init(jax.random.key(0)).task_replay
    drawn = data(best.draw_tasks(task_replay, jax.random.key(1)))
    once = data(task_replay.keys[0])
    twice = data(task_replay.keys[1])
    assert len(set(drawn[:4]) - {*once, *twice}) == 4
    assert set(drawn[4:6]) <= set(once)
    assert set(drawn[6:]) <= set(twice)


def test_an_iteration_remembers_failed_tasks_and_counts_successes_and_steps(scripted):
    """Success is that on new tasks."""
    _, state, iterate = scripted
    after, metrics = iterate(state)
    keys, first, second = data(reset_keys()), *map(data, state.task_replay.keys)
    # New tasks 1, 2, 3 failed, and of the tasks failed once the first.
    assert data(after.task_replay.keys[0]) == [*keys[1:4], *first[3:]]
    assert data(after.task_replay.keys[1]) == [keys[4], *second[1:]]
    assert float(metrics["success"]) == 1 / 4
    assert float(metrics["replayed_success"]) == 3 / 4
    assert float(metrics["episode_length"]) == STEPS
    after, _ = iterate(after)
    assert (int(after.iteration), int(after.transitions)) == (2, 2 * EPISODES * STEPS)


def test_the_next_iteration_gets_what_this_one_has_learned(scripted):
    """Variances move by a tenth, after an iteration in which they were 4 and 9."""
    _, state, iterate = scripted
    first, _ = iterate(state)
    later, _ = iterate(
        state._replace(iteration=jnp.int32(1), reward_variance=jnp.array([4.0, 9.0]))
    )
    expected = 0.9 * np.array([4, 9]) + 0.1 * np.asarray(first.reward_variance)
    np.testing.assert_allclose(later.reward_variance, expected, rtol=1e-5)
    for name in ("params", "opt_state", "memory"):
        assert_same(getattr(first, name), plus_one(getattr(state, name)))


def test_metrics_of_play_are_means_over_episodes_and_over_steps_taken():
    nothing: Any = None
    mask = jnp.array([[1.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    episodes = Episodes(nothing, nothing, nothing, nothing, nothing, mask)
    reward = jnp.array([[1.0, 3.0, 0.0], [2.0, 0.0, 0.0]])
    metrics = make_learner(PLAIN).play_metrics(episodes, reward, jnp.array([True, False]))
    assert metrics == {"episode_length": 1.5, "intrinsic_reward": 2, "success": 0.5}


@pytest.mark.parametrize(("iteration", "coef"), [(0, 3.0), (4, 0.3), (8, 0.03), (9, 0.03)])
def test_the_intrinsic_coefficient_is_the_iterations(scripted, iteration, coef):
    scripted, state, iterate = scripted
    _, metrics = iterate(state._replace(iteration=jnp.int32(iteration)))
    trajectory = scripted.play(None, reset_keys(), None)
    reward, _ = scripted.intrinsic_reward(state, trajectory)
    variance = advantages.update_variance(
        BEST, state.reward_variance, jnp.int32(iteration), trajectory.episodes, reward
    )
    expected, _ = advantages.estimate(
        BEST, trajectory.episodes, reward, coef, trajectory.value, variance
    )
    # Normalised once more.
    expected = (expected - expected.mean()) / expected.std()
    np.testing.assert_allclose(metrics["advantage"], expected, atol=1e-4)


def test_episodes_are_played_facing_the_food():
    keys = jax.random.split(jax.random.key(1), 64)
    best = by_plain_path(BEST)
    params = jax.eval_shape(best.init, jax.random.key(0)).params
    params = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), params)
    played = jax.jit(best.play)(params, keys, jax.random.key(2))
    start, _ = jax.jit(jax.vmap(tt.make("pstsy").reset))(keys)
    down, right = np.asarray(played.episodes.layout.food - played.episodes.layout.agent).T
    assert np.all((down >= right) & (right >= 0))
    assert not np.all(start.food >= start.agent)


def recorder(updates: int) -> optax.GradientTransformation:
    """Gradient descent of rate 0.5, whose state holds all gradients [updates, EPISODES]."""

    def init(params: Any) -> Any:
        return jnp.zeros((), jnp.int32), jnp.zeros((updates, *params.shape))

    def update(updates: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        count, seen = state
        return -0.5 * updates, (count + 1, seen.at[count].set(updates))

    return optax.GradientTransformation(init, update)


class Counting(Learner):
    """Its gradient is 1 at the episodes of the minibatch, and its metric their mean number."""

    def loss(self, params: Any, batch: Any):
        return jnp.sum(params[batch.log_prob]), {"number": jnp.mean(batch.log_prob)}


def test_every_epoch_takes_every_episode_once_in_a_new_order():
    """The metrics are means over all gradient steps."""
    updates = BEST.gradient_steps
    counting = Counting(**{**vars(make_learner(BEST)), "optimizer": recorder(updates)})
    params = jnp.zeros(EPISODES)
    state = TrainState(params, counting.optimizer.init(params), *[None] * 6)  # pyright: ignore
    index: Any = jnp.arange(EPISODES)
    batch = learner.Batch(*[index] * 4)
    after, (count, seen), metrics = counting.update(state, batch, jax.random.key(0))
    assert count == updates == 3 * 2
    np.testing.assert_array_equal(after, -1.5)
    epochs = np.asarray(seen).reshape(3, 2, EPISODES)
    np.testing.assert_array_equal(epochs.sum(axis=2), 4)
    np.testing.assert_array_equal(epochs.sum(axis=1), 1)
    assert len({epoch[0].tobytes() for epoch in epochs}) > 1
    assert metrics == {"number": 3.5, "gradient_norm": 2}


@pytest.mark.slow
def test_seeds_trained_by_vmap_equal_seeds_trained_alone():
    """With the cache of encodings and the loops of the real rollout; up to rounding."""
    plain = make_learner(dataclasses.replace(PLAIN, env_id="sy"))
    both = jax.vmap(plain.init)(jax.vmap(jax.random.key)(jnp.array([3, 4])))
    together = jax.jit(jax.vmap(plain.iterate))(both)
    alone = jax.jit(plain.iterate)
    for seed in range(2):
        expected = to_arrays(alone(rows(both, seed)))
        got = to_arrays(rows(together, seed))
        assert got.keys() == expected.keys()
        for name, array in got.items():
            np.testing.assert_allclose(array, expected[name], rtol=1e-4, atol=1e-5, err_msg=name)


def test_an_iteration_of_best_is_finite_changes_all_parameters_and_reuses_no_key():
    best = by_plain_path(dataclasses.replace(BEST, epochs=1))
    state = jax.jit(best.init)(jax.random.key(0))
    assert state.params["heads"]["params"]["value"]["kernel"].shape == (4, 2)
    iterate = jax.jit(best.iterate)
    with jax.debug_key_reuse(True):
        after, metrics = iterate(state)
        iterate(after)
    assert all(np.isfinite(float(value)) for value in metrics.values())
    before = to_arrays(state.params)
    after = to_arrays(after.params)
    same = [name for name in before if np.array_equal(before[name], after[name])]
    assert same == ["core/params/reward_embedding/kernel"]  # no reward was met


@pytest.mark.parametrize("curiosity", ["icm", "rnd"])
def test_every_part_of_the_parameters_is_drawn_with_a_key_of_its_own(curiosity):
    made = make_learner(dataclasses.replace(BEST, curiosity=curiosity))
    with jax.debug_key_reuse(True):
        made.init(jax.random.key(0))


class Known(Learner):
    """Has seen an episode of two steps, of which the second is padding."""

    def experience(self, params, episodes):
        hidden = self.config.hidden
        width = 2 * self.config.embedding
        outputs = (jnp.zeros((1, 2, hidden)), None, jnp.zeros((1, 2, width)))
        return Experience(episodes, jnp.zeros((1, 3, 0)), *outputs)


def test_the_loss_adds_weighted_terms_of_the_steps_that_were_taken():
    """By parameters of 0: all actions and motions are as likely, and all values 0."""
    weights = {"value_coef": 0.5, "entropy_coef": 0.1, "motion_coef": 0.25, "curiosity_coef": 3.0}
    two_heads = {"curiosity": "effects", "value_heads": "separate", "bootstrap": "value"}
    made = make_learner(Config(**{**SETTINGS, **weights, **two_heads}))
    custom = Returning(losses={"own_loss": jnp.ones((1, 2))})
    params = jax.eval_shape(made.init, jax.random.key(0)).params
    params = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), params)
    mask = jnp.array([[1.0, 0.0]])
    cells = jnp.zeros((1, 3, 3, 2), jnp.uint8)
    episodes = Episodes(tt.base_state(), cells, jnp.zeros((1, 2, 2), jnp.int32), *[mask] * 3)
    old = jnp.full((1, 2), -2 * np.log(4) - np.log(1.5), jnp.float32)  # clipped to 1.2
    target = jnp.array([[[3.0, 4.0], [9.0, 9.0]]])
    batch = learner.Batch(episodes, old, jnp.array([[2.0, 9.0]]), target)
    known = Known(**{**vars(made), "curiosity": custom})
    total, found = known.loss(params, batch)
    expected = {
        "policy_loss": -1.2 * 2 / 2,
        "value_loss": 0.5 * (9 + 16) / 2,
        "entropy_loss": -0.1 * 2 * np.log(4) / 2,
        "motion_loss": 0.25 * 6 * np.log(2) / 2,
        "own_loss": 3.0 * 1 / 2,
    }
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=1e-5, err_msg=name)
    np.testing.assert_allclose(total, sum(expected.values()), rtol=1e-5)
    assert found["entropy"] == pytest.approx(2 * np.log(4))
    both_taken = batch._replace(episodes=episodes._replace(mask=jnp.ones((1, 2))))
    _, found = known.loss(params, both_taken)
    assert found["entropy"] == pytest.approx(2 * np.log(4)), "a mean over steps taken"


def test_an_intrinsic_reward_is_zero_after_the_end_of_an_episode():
    nothing: Any = None
    custom = Returning(reward=jnp.ones((1, 2)))
    learner = Known(**{**vars(make_learner(PLAIN)), "curiosity": custom})
    mask = jnp.array([[1.0, 0.0]])
    episodes = Episodes(nothing, nothing, nothing, nothing, nothing, mask)
    state: Any = SimpleNamespace(params={"curiosity": {}}, memory=jnp.int32(7))
    trajectory = Trajectory(nothing, episodes, nothing, nothing)
    reward, memory = learner.intrinsic_reward(state, trajectory)
    np.testing.assert_array_equal(reward, [[1, 0]])
    assert memory == 7


@pytest.mark.parametrize("backend", ["gpu", "tpu"])
def test_an_accelerator_takes_the_plain_path(backend, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    made = make_learner(PLAIN)
    assert made.encoding.name == "plain"
    assert made.agent.core.scan_unroll > 1


@pytest.mark.parametrize("preset", PRESETS)
def test_an_iteration_can_be_compiled_for_a_gpu(preset, monkeypatch):
    """Every operation has a rule of its own there, or a custom call would stand for it."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    learner = make_learner(Config.preset(preset))
    state = jax.eval_shape(learner.init, jax.random.key(0))
    lowered = jax.jit(learner.iterate).trace(state).lower(lowering_platforms=("cuda",))
    assert "custom_call" not in lowered.as_text()


@pytest.mark.parametrize(
    ("settings", "env", "message"),
    [
        ({"max_steps": 10_000}, None, r"2,560,000,000 steps; allowed: at most 2,147,483,647"),
        ({"max_steps": 7}, tt.Environment(max_steps=6), "max_steps is 6, the config's 7"),
        ({}, tt.make("base", num_features=4), "num_features is 4, the config's 3"),
        ({}, tt.AutoReset(tt.Environment()), "must be a trap_tube_jax.Environment, not wrapped"),
        ({"encoder": "objects"}, OWN_COLORS, "know agent and food by the colours"),
        ({"align_to_food": True}, OWN_COLORS, "know agent and food by the colours"),
        ({"iterations": 2**20, "epochs": 10_000, "max_steps": 1}, None, "gradient steps"),
    ],
)
def test_settings_that_cannot_be_trained_with_are_refused(settings, env, message):
    with pytest.raises(ValueError, match=message):
        make_learner(Config(**settings), env)


@pytest.mark.parametrize("transfers", [(tt.perceptual, recolour), (recolour_rarely,), (MIXED,)])
def test_a_turned_board_needs_the_colours_of_agent_and_food(transfers):
    with pytest.raises(ValueError, match="know agent and food by the colours"):
        make_learner(Config(align_to_food=True), tt.Environment(transfers))
