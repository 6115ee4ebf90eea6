"""The gymnax adapter, under gymnax 0.x and 1.x and under agents written for it."""

import copy
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt

gymnax = pytest.importorskip("gymnax")
spaces = gymnax.environments.spaces
wrappers = pytest.importorskip("gymnax.wrappers")

from trap_tube_jax.adapters import to_gymnax

pytestmark = pytest.mark.interop
needs_six_values = pytest.mark.skipif(
    not to_gymnax.HAS_SIX_VALUES, reason="gymnax before 1.0 has neither six values nor registration"
)


@pytest.fixture(scope="module")
def easy(easy_env):
    return to_gymnax.make(easy_env)


def test_spaces_and_parameters_are_gymnaxs(easy):
    env, params = easy
    assert isinstance(env, gymnax.environments.environment.Environment)
    assert isinstance(env.action_space(params), spaces.Discrete)
    assert env.action_space(params).n == env.num_actions == 16
    box = env.observation_space(params)
    assert isinstance(box, spaces.Box)
    assert (box.low, box.high, box.shape, box.dtype) == (0, 255, (12, 12, 3), jnp.uint8)
    observation, state = env.reset(jax.random.key(0), params)
    assert (observation.shape, observation.dtype) == (box.shape, box.dtype)
    assert env.get_obs(state).tolist() == observation.tolist()
    assert jax.tree.leaves(params) == [6]
    assert hash(params) == hash(params.replace(max_steps_in_episode=6))
    assert isinstance(params, gymnax.EnvParams)
    assert to_gymnax.make("TrapTube-v0")[1].max_steps_in_episode == 50
    env, params = to_gymnax.make("p", num_features=5)
    assert env.observation_space(params).shape == (12, 12, 5)


def test_five_values_equal_those_of_the_wrapped_environment(easy, easy_env):
    env, params = easy
    observation, state = env.reset(jax.random.PRNGKey(0), params)
    below, timestep = easy_env.reset(jax.random.key(0))
    np.testing.assert_array_equal(observation, timestep.observation)
    for index, success in ((3, False), (1, True)):
        below, timestep = easy_env.step(below, tt.action_from_index(jnp.int32(index)))
        observation, state, reward, done, info = env.step(jax.random.key(1), state, index, params)
        assert (bool(done), float(reward)) == (success, float(timestep.reward))
        assert bool(info["terminated"]) == success
        assert float(info["discount"]) == 1.0 - success
        assert {key: value.shape for key, value in info.items()} == dict.fromkeys(
            ("discount", "terminated", "truncated"), ()
        )
    # The solved episode is over: what came back starts the next.
    np.testing.assert_array_equal(observation, tt.observe(easy_env.base))
    assert int(state.time) == 0


def test_the_limit_changes_without_compiling_again(easy):
    env, params = easy
    key = jax.random.key(0)
    ends = []
    for limit in (2, 3):
        params = params.replace(max_steps_in_episode=limit)
        _, state = env.reset(key, params)
        for time in range(limit):
            _, state, _, done, info = env.step(key, state, 0, params)
            assert bool(done) == bool(info["truncated"]) == (time == limit - 1)
            assert float(info["discount"]) == 1.0
        ends.append(type(env).step._cache_size())
    assert ends[0] == ends[1]


def test_a_finished_episode_stays_without_the_reset(easy):
    env, params = easy
    key = jax.random.key(0)
    _, state = env.reset(key, params)
    for index in (3, 1):
        _, state, *_ = env.step_env(key, state, index, params)
    assert env.is_terminal(state, params)
    assert env.discount(state, params) == 0.0
    _, after, reward, done, _ = env.step_env(key, state, 0, params)
    assert (float(reward), bool(done)) == (0.0, True)
    np.testing.assert_array_equal(after.agent, state.agent)


def test_pairs_as_actions_batches_and_copies(easy, easy_env):
    env, params = to_gymnax.make(easy_env, flat_actions=False)
    assert isinstance(env.action_space(params), spaces.Tuple)
    flat = pickle.loads(pickle.dumps(copy.deepcopy(easy[0])))
    keys = jax.random.split(jax.random.key(0), 3)
    _, states = jax.vmap(flat.reset, in_axes=(0, None))(keys, params)
    indices = jnp.array([0, 7, 9])
    results = [
        jax.vmap(adapter.step, in_axes=(0, 0, 0, None))(keys, states, actions, params)
        for adapter, actions in ((flat, indices), (env, jnp.divmod(indices, 4)))
    ]
    jax.tree.map(np.testing.assert_array_equal, *results)
    assert results[0][0].shape == (3, 12, 12, 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nonesuch", {}), "unknown task set 'nonesuch'; allowed"),
        ((tt.Environment(), {"num_features": 2}), "does not apply"),
    ],
)
def test_invalid_arguments_are_refused(arguments, message):
    task_set, options = arguments
    with pytest.raises(ValueError, match=message):
        to_gymnax.make(task_set, **options)


@pytest.mark.parametrize("index", [16, -1, jnp.int32(99), np.int64(16)])
def test_indices_of_no_action_are_no_directions(easy, easy_env, index):
    env, params = easy
    key = jax.random.key(0)
    _, state = env.reset(key, params)
    for adapter in (env, to_gymnax.SixValueTrapTube(easy_env)):
        after = adapter.step(key, state, index, params)[1]
        np.testing.assert_array_equal(after.agent, state.agent)
        assert after.time == 1


def test_a_pair_in_place_of_an_index_is_answered_with_the_option(easy):
    env, params = easy
    _, state = env.reset(jax.random.key(0), params)
    with pytest.raises(ValueError, match="flat_actions=False to pass"):
        env.step(jax.random.key(0), state, np.array([0, 3]), params)


@needs_six_values
def test_a_custom_set_may_be_registered_again(fresh_task_sets):
    for limit in (7, 9):
        tt.register("GymnaxTest-v0", (), max_steps=limit)
        to_gymnax.register()
        assert gymnax.make("GymnaxTest-v0")[1].max_steps_in_episode == limit


@needs_six_values
def test_gymnax_makes_a_task_set():
    name = "PerceptualTrapTube-v0"
    env, params = gymnax.make(name)
    assert isinstance(env, to_gymnax.SixValueTrapTube)
    assert (env.name, params.max_steps_in_episode) == (name, 50)


@needs_six_values
def test_six_values_agree_with_five(easy, easy_env):
    five, params = easy
    six = to_gymnax.SixValueTrapTube(easy_env)
    legacy = wrappers.LegacyStepAPIWrapper(six)
    _, state = five.reset(jax.random.key(0), params)
    for time, index in enumerate((0, 0, 0, 0, 0, 0, 3, 1)):
        key = jax.random.key(time)
        observation, following, reward, terminated, truncated, info = six.step(
            key, state, index, params
        )
        assert (bool(terminated), bool(truncated)) == (time == 7, time == 5)
        assert info["final_observation"].shape == (12, 12, 3)
        expected = five.step(key, state, index, params)
        for one, other in zip(
            jax.tree.leaves((observation, following, reward)),
            jax.tree.leaves(expected[:3]),
            strict=True,
        ):
            np.testing.assert_array_equal(one, other)
        assert legacy.step(key, state, index, params)[3] == expected[3] == (time in (5, 7))
        state = following


@pytest.mark.skipif(to_gymnax.HAS_SIX_VALUES, reason="gymnax 1.0 registers")
def test_registration_needs_gymnax_1():
    with pytest.raises(ImportError, match=r"to_gymnax.make instead"):
        to_gymnax.register()
