"""Intrinsic rewards: the registry of names, a curiosity from outside, visit counts."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents import Config, make_train, registry
from agents.acting.episodes import Episodes
from agents.acting.identity import observation_ids
from agents.curiosity import Curiosity, counts, register
from agents.curiosity.checks import check_curiosity, shapes_of
from agents.curiosity.counts import observation_slots, visit_bonus
from refusal import assert_refused

TINY = Config(
    env_id="sy",
    max_steps=4,
    episodes_per_iteration=4,
    minibatch_size=2,
    epochs=1,
    filters=(2, 3),
    hidden=4,
    embedding=2,
    encode_chunk_size=4,
    curiosity="none",
).to_dict()


class Corners(Curiosity):
    """Pays where the agent comes to a corner, and counts its calls."""

    def memory(self):
        return jnp.zeros((), jnp.int32)

    def reward(self, params, memory, experience):
        agent = experience.episodes.cells[1:, :, 0]
        return jnp.all(agent % 11 == 0, axis=-1).astype(jnp.float32), memory + 1


class Plain(Curiosity):
    """Encodes without parameters, pays NaN after an episode's end, and has a loss of any name."""

    def __init__(self, loss="value_loss"):
        self.loss = loss

    def encode(self, params, observation):
        return observation.reshape(len(observation), -1)[:, :3] / 255.0

    def reward(self, params, memory, experience):
        mask = experience.episodes.mask
        return experience.features[1:, :, 0] * 0 + 1 / mask - jnp.where(mask, 0.0, jnp.inf), memory

    def losses(self, params, experience):
        return {self.loss: experience.episodes.mask}


@pytest.fixture(scope="module")
def trajectory():
    """Random episodes of {Sy}, 40 of 4 steps."""
    learner = make_train(Config.from_dict({**TINY, "episodes": 40}))
    params = jax.jit(learner.init_params)(jax.random.key(0))
    reset_keys = jax.random.split(jax.random.key(1), 40)
    return jax.jit(learner.play)(params, reset_keys, jax.random.key(2))


@pytest.fixture(autouse=True)
def own_table(monkeypatch):
    monkeypatch.setattr(registry.curiosities, "_factories", dict(registry.curiosities._factories))


def test_a_curiosity_of_ones_own_is_trained_with(trajectory):
    register("corners", lambda config, env: Corners())
    train = make_train(Config.from_dict({**TINY, "curiosity": "corners"}))
    start = jax.jit(train.init)(jax.random.key(0))
    episodes = trajectory.episodes
    cells = episodes.cells.at[1, 0, 0].set(jnp.array([11, 0], jnp.uint8))
    trajectory = trajectory._replace(episodes=episodes._replace(cells=cells))
    reward, memory = jax.jit(train.intrinsic_reward)(start, trajectory)
    corner = np.isin(np.asarray(cells[1:, :, 0]), [0, 11]).all(-1)
    np.testing.assert_array_equal(reward, corner)
    assert reward[0, 0] == 1
    assert memory == 1


def test_a_curiosity_without_parameters_encodes_and_may_pay_anything_after_the_end(trajectory):
    register("plain", lambda config, env: Plain())
    train = make_train(Config.from_dict({**TINY, "curiosity": "plain"}))
    episodes = trajectory.episodes
    episodes = episodes._replace(mask=episodes.mask.at[2:, 0].set(0.0))
    start = jax.jit(train.init)(jax.random.key(0))
    shortened = trajectory._replace(episodes=episodes)
    reward, _ = jax.jit(train.intrinsic_reward)(start, shortened)
    np.testing.assert_array_equal(reward, episodes.mask)


@pytest.mark.parametrize("name", ["value_loss", "success", "greedy_mine"])
def test_losses_called_like_metrics_are_refused(name):
    register("plain", lambda config, env: Plain(name))
    train = make_train(Config.from_dict({**TINY, "curiosity": "plain"}))
    start = jax.eval_shape(train.init, jax.random.key(0))
    with pytest.raises(ValueError, match=f"need names of their own, got {name}"):
        jax.eval_shape(train.iterate, start)


def test_names_are_checked_against_the_registry():
    with pytest.raises(ValueError, match=r"unknown curiosity 'rdn'; allowed: icm, .*counts, none"):
        Config(curiosity="rdn")
    with pytest.raises(ValueError, match="curiosity 'icm' is registered already"):
        register("icm", lambda config, env: Curiosity())


def test_the_same_file_may_register_a_name_again():
    register("mine", lambda config, env: Corners())
    register("mine", lambda config, env: Plain())
    assert isinstance(registry.curiosities.factory("mine")(None, None), Plain)
    with pytest.raises(ValueError, match="curiosity 'mine' is registered already"):
        exec('register("mine", print)', {"register": register, "__name__": "elsewhere"})


@pytest.mark.parametrize(
    ("name", "factory", "words"),
    [
        ("mine", Corners(), ["curiosity 'mine' needs a function", "Corners object"]),
        ("a+b, c", Corners, ["curiosity names consist of letters, digits", "'a+b, c'"]),
        (7, Corners, ["curiosity names consist of letters, digits", "got 7"]),
    ],
)
def test_instances_and_names_that_cannot_be_typed_are_refused(name, factory, words):
    assert_refused(words, register, name, factory)


class Scalar(Corners):
    def reward(self, params, memory, experience):
        return jnp.sum(experience.episodes.reward), memory


class Alone(Corners):
    def reward(self, params, memory, experience):
        return experience.episodes.reward


class Drifting(Corners):
    def reward(self, params, memory, experience):
        return experience.episodes.reward, memory + 0.5


class Forgetful(Corners):
    def reward(self, params, memory, experience):
        return experience.embedding.sum(-1), memory


class ForgetfulLoss(Corners):
    def losses(self, params, experience):
        return {"own": experience.next_embedding.sum(-1)}


class Embedded(Corners):
    needs_embeddings = True

    def reward(self, params, memory, experience):
        both = (experience.embedding + experience.next_embedding).sum(-1)
        return both + experience.action_embedding.sum(-1), memory


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        (Scalar, ["Scalar.reward must return (reward f32[T, B], memory)", "got (float32[], int32"]),
        (Alone, ["(float32[4, 4], int32[]), got float32[4, 4]"]),
        (Drifting, ["(float32[4, 4], int32[]), got (float32[4, 4], float32[])"]),
        (Forgetful, ["Forgetful.reward failed", "unless needs_embeddings = True"]),
        (ForgetfulLoss, ["ForgetfulLoss.losses failed", "unless needs_embeddings = True"]),
        (lambda: Corners, ["'mine' must be an agents.curiosity.Curiosity, got <class"]),
    ],
)
def test_curiosities_that_break_their_contract_are_refused(kind, words):
    register("mine", lambda config, env: kind())
    assert_refused(words, make_train, Config.from_dict({**TINY, "curiosity": "mine"}))


def test_the_contract_is_checked_with_the_shapes_of_training(trajectory):
    """Those of what an iteration gives, and with every curiosity of the project."""
    register("mine", lambda config, env: Embedded())
    for name in ("mine", "icm", "rnd", "effects", "counts", "none"):
        config = Config.from_dict({**TINY, "episodes_per_iteration": 40, "curiosity": name})
        train = make_train(config)
        check_curiosity(train.curiosity, config, train.env)
        params = jax.eval_shape(train.init_params, jax.random.key(0))
        given = jax.eval_shape(train.acting_experience, params, trajectory)
        checked = shapes_of(train.curiosity, params["curiosity"], config, train.env)
        assert jax.tree.map(lambda x: (x.shape, x.dtype), given) == jax.tree.map(
            lambda x: (x.shape, x.dtype), checked
        )


@pytest.mark.parametrize("env_id", ["base", "sy"])
def test_counts_are_for_tasks_that_return(env_id):
    make_train(Config.preset("fast", env_id=env_id, curiosity="counts"))


@pytest.mark.parametrize("env_id", ["p", "st", "pstsy"])
def test_counts_are_refused_where_tasks_do_not_return(env_id):
    with pytest.raises(ValueError, match=r"'counts' needs tasks that return: base or Sy"):
        make_train(Config.preset("fast", env_id=env_id, curiosity="counts"))


def test_visits_are_counted_and_pay_by_their_root():
    slot = jnp.array([[3, 3], [5, 3]])
    mask = jnp.array([[1.0, 1.0], [1.0, 0.0]])
    bonus, visits = visit_bonus(jnp.zeros(8).at[5].set(3.0), slot, mask)
    np.testing.assert_allclose(bonus, [[2**-0.5, 2**-0.5], [0.5, 0.0]], rtol=1e-6)
    np.testing.assert_array_equal(visits, [0, 0, 0, 2, 0, 4, 0, 0])


def test_few_observations_share_a_slot(trajectory):
    """No more of 4000 positions on each layout of {Sy} than chance would have it, here 1 %."""
    cells = jax.random.randint(jax.random.key(2), (4000, 1, 3, 2), 0, 12).astype(jnp.uint8)
    cells = jnp.broadcast_to(cells, (4000, 40, 3, 2))
    episodes = trajectory.episodes._replace(cells=cells)
    slot, identity = (jax.jit(of)(episodes) for of in (observation_slots, observation_ids))
    distinct = int(identity.max()) + 1
    assert distinct > 19_900
    assert 0.98 * distinct < len(np.unique(slot)) <= distinct


def test_layouts_of_near_hashes_share_few_slots(trajectory, monkeypatch):
    """Of 40 layouts with 144 positions in a row, again no more than chance would have it."""
    near: Any = lambda layout: jnp.arange(40, dtype=jnp.uint32)  # noqa: E731
    monkeypatch.setattr(counts, "layout_hashes", near)
    food = jnp.stack(jnp.divmod(jnp.arange(144), 12), axis=-1)
    cells = jnp.zeros((144, 40, 3, 2), jnp.uint8).at[:, :, 2].set(food[:, None].astype(jnp.uint8))
    slot = jax.jit(observation_slots)(trajectory.episodes._replace(cells=cells))
    assert len(np.unique(slot)) > 0.98 * slot.size


def test_every_observation_keeps_its_slot(trajectory):
    episodes = trajectory.episodes
    slot = np.asarray(jax.jit(observation_slots)(episodes))
    boards = np.asarray(jax.jit(Episodes.observations)(episodes)).reshape(slot.size, -1)
    cells = np.asarray(episodes.cells).reshape(slot.size, -1)
    _, same = np.unique(np.concatenate([boards, cells], axis=1), axis=0, return_inverse=True)
    assert same.max() + 1 < slot.size
    for number in range(same.max() + 1):
        assert len(set(slot.reshape(-1)[same.reshape(-1) == number].tolist())) == 1
