"""The Gymnasium adapter under Gymnasium's own tools."""

import copy
import functools
import pickle
from typing import Any

import cloudpickle
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt

gymnasium = pytest.importorskip("gymnasium")

check_env = pytest.importorskip("gymnasium.utils.env_checker").check_env
AutoresetMode = gymnasium.vector.AutoresetMode
AUTORESET_MODES = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)
SyncVectorEnv = gymnasium.vector.SyncVectorEnv

from trap_tube_jax.adapters.to_gymnasium import TrapTubeEnv, TrapTubeVectorEnv, register

pytestmark = pytest.mark.interop


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("PerceptualTrapTube-v0", {"render_mode": "rgb_array", "cell_size": 8}),
        ("TrapTube-v0", {"flat_actions": True, "render_mode": "ansi", "num_features": 5}),
    ],
)
def test_the_environment_checker_finds_nothing(name, options):
    check_env(gymnasium.make(f"trap_tube_jax/{name}", **options).unwrapped)


def test_a_seeded_episode_equals_one_of_the_wrapped_environment():
    env = gymnasium.make("trap_tube_jax/PerceptualTrapTube-v0")
    below = tt.AutoReset(tt.make("p"))
    observation, _ = env.reset(seed=3)
    state, timestep = jax.jit(below.reset)(jax.random.key(3))
    np.testing.assert_array_equal(observation, timestep.observation)
    for action in env.action_space.sample(), env.action_space.sample():
        observation, reward, *flags, info = env.step(action)
        state, timestep = jax.jit(below.step)(state, jnp.asarray(action))
        np.testing.assert_array_equal(observation, timestep.observation)
        assert (type(reward), [type(flag) for flag in flags], info) == (float, [bool, bool], {})
    # Without a seed the sequence goes on; with the same seed it starts anew.
    following, _ = env.reset()
    np.testing.assert_array_equal(
        env.reset(seed=3)[0], jax.jit(below.reset)(jax.random.key(3))[1].observation
    )
    np.testing.assert_array_equal(env.reset()[0], following)


def test_an_episode_ends_with_success_or_at_the_limit_with_actions_of_either_kind(easy_env):
    for flat, space in (
        (True, gymnasium.spaces.Discrete(16)),
        (False, gymnasium.spaces.MultiDiscrete([4, 4])),
    ):
        env = TrapTubeEnv(easy_env, flat_actions=flat)
        assert env.action_space == space
        env.reset(seed=0)
        for move, expected in ((3, (0.0, False, False)), (1, (1.0, True, False))):
            assert env.step(8 + move if flat else [2, move])[1:4] == expected
        env.reset()
        ends = [env.step(0 if flat else [0, 0])[2:4] for _ in range(6)]
        assert ends == [(False, False)] * 5 + [(False, True)]


@pytest.mark.parametrize("mode", AUTORESET_MODES)
@pytest.mark.parametrize("flat", [False, True])
def test_the_batch_equals_gymnasiums_vector_environment(mode, flat, easy_env):
    """On tasks that are drawn, and on one that random actions solve."""
    for task_set in (tt.make("p", max_steps=5), easy_env):
        options = {"task_set": task_set, "flat_actions": flat}
        ours = TrapTubeVectorEnv(num_envs=3, autoreset_mode=mode, **options)
        theirs = SyncVectorEnv([functools.partial(TrapTubeEnv, **options)] * 3, autoreset_mode=mode)
        assert ours.action_space == theirs.action_space
        assert ours.observation_space == theirs.observation_space
        np.testing.assert_array_equal(ours.reset(seed=7)[0], theirs.reset(seed=7)[0])
        ours.action_space.seed(1)
        total = 0.0
        for _ in range(14 if task_set is not easy_env else 60):
            actions = ours.action_space.sample()
            step = ours.step(actions)
            assert_same(step, theirs.step(actions))
            total += step[1].sum()
        np.testing.assert_array_equal(ours.reset()[0], theirs.reset()[0])
    assert total >= 2


def assert_same(ours, theirs):
    for one, other in zip(ours[:4], theirs[:4], strict=True):
        np.testing.assert_array_equal(one, other)
        assert one.dtype == other.dtype
    assert ours[4].keys() == theirs[4].keys()
    if "final_obs" in ours[4]:
        assert ours[4]["final_info"] == theirs[4]["final_info"]
        np.testing.assert_array_equal(ours[4]["_final_obs"], theirs[4]["_final_obs"])
        np.testing.assert_array_equal(ours[4]["_final_info"], theirs[4]["_final_info"])
        for one, other in zip(ours[4]["final_obs"], theirs[4]["final_obs"], strict=True):
            np.testing.assert_array_equal(one, other)


def test_make_vec_makes_the_compiled_batch():
    envs = gymnasium.make_vec(
        "trap_tube_jax/TrapTube-v0", num_envs=2, autoreset_mode="SameStep", max_steps=3
    )
    assert isinstance(envs.unwrapped, TrapTubeVectorEnv)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    assert TrapTubeVectorEnv.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP


@pytest.mark.parametrize(("limit", "length"), [(3, 3), (9, 5)])
def test_the_smaller_of_two_step_limits_holds_for_one_and_many(limit, length):
    options = {"max_steps": 5, "max_episode_steps": limit}
    one = gymnasium.make("trap_tube_jax/TrapTube-v0", **options)
    many = gymnasium.make_vec("trap_tube_jax/TrapTube-v0", num_envs=2, **options)
    one.reset(seed=0)
    many.reset(seed=0)
    for time in range(1, length + 1):
        assert one.step([0, 0])[3] == (time == length)
        assert many.step([[0, 0]] * 2)[3].tolist() == [time == length] * 2


def test_steps_do_not_loop_over_environments():
    calls = []

    def counted(key, state):
        calls.append(key)
        return state

    envs = TrapTubeVectorEnv(tt.Environment((counted,), max_steps=2), num_envs=64)
    envs.reset(seed=0)
    for _ in range(7):
        envs.step(envs.action_space.sample())
    assert len(calls) < 16


def test_batches_reset_again_under_any_kind_of_key_and_use_none_twice():
    def observations():
        envs = TrapTubeVectorEnv("p", 2)
        envs.reset(seed=3)
        again = envs.reset()[0]
        return [again, envs.reset(seed=[4, 5])[0], envs.reset()[0]]

    expected = observations()
    for setting in (jax.default_prng_impl("rbg"), jax.debug_key_reuse(True)):
        with setting:
            np.testing.assert_array_equal(observations(), expected)


def test_seeds_and_options_are_checked():
    envs = TrapTubeVectorEnv("p", 2)
    pair = envs.reset(seed=[5, 9])[0]
    np.testing.assert_array_equal(pair[1], envs.reset(seed=9)[0][0])
    assert not np.array_equal(*TrapTubeVectorEnv("p", 2).reset()[0])
    # Those that Gymnasium draws without a seed are as large as these.
    np.testing.assert_array_equal(envs.reset(seed=[2**32 + 5, 2**96 + 9])[0], pair)
    one: Any = np.int64(9)
    np.testing.assert_array_equal(envs.reset(seed=one)[0][0], pair[1])
    with pytest.raises(ValueError, match=r"takes no options.*reset_mask"):
        envs.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(ValueError, match="one or 2 integers, got 3"):
        envs.reset(seed=[1, 2, 3])
    wrong_seeds: list[Any] = [[1, None], [1, -1], -1, 1.5, True, "9"]
    for seed in wrong_seeds:
        wrong = seed[1] if isinstance(seed, list) else seed
        with pytest.raises(ValueError, match=f"seed must be an integer >= 0, got {wrong!r}"):
            envs.reset(seed=seed)


def test_render_modes_show_the_pictures_of_the_package(easy_env):
    env = TrapTubeEnv(easy_env, render_mode="rgb_array", cell_size=8)
    env.reset(seed=0)
    np.testing.assert_array_equal(env.render(), tt.render(easy_env.base, 8))
    text = TrapTubeVectorEnv(easy_env, 2, render_mode="ansi")
    text.reset(seed=0)
    assert text.render() == (tt.render_ascii(easy_env.base),) * 2
    batch = TrapTubeVectorEnv(easy_env, 2, render_mode="rgb_array", cell_size=8)
    batch.reset(seed=0)
    np.testing.assert_array_equal(np.stack(batch.render() or ())[1], env.render())


def test_observations_are_the_callers_to_change(easy_env):
    for env in TrapTubeEnv(easy_env), TrapTubeVectorEnv(easy_env, 2):
        observation, _ = env.reset(seed=0)
        observation[...] = 0
        following = env.step(env.action_space.sample())[0]
        assert following.flags.writeable
        assert following.any()
    envs = TrapTubeVectorEnv(tt.Environment(max_steps=1), 2, autoreset_mode="SameStep")
    envs.reset(seed=0)
    assert envs.step([[0, 0], [0, 0]])[4]["final_obs"][0].flags.writeable


def test_custom_task_sets_can_be_registered(fresh_task_sets):
    tt.register("GymnasiumTest-v0", (tt.perceptual,))
    register()
    env = gymnasium.make("trap_tube_jax/GymnasiumTest-v0")
    assert env.reset(seed=0)[0].shape == (12, 12, 3)
    tt.register("GymnasiumTest-v0", (), max_steps=7)
    assert gymnasium.make("trap_tube_jax/GymnasiumTest-v0").unwrapped.env.max_steps == 7


@pytest.mark.parametrize(
    "duplicate",
    [
        copy.deepcopy,
        lambda env: pickle.loads(pickle.dumps(env)),
        lambda env: cloudpickle.loads(cloudpickle.dumps(env)),
    ],
)
@pytest.mark.parametrize("make", [TrapTubeEnv, functools.partial(TrapTubeVectorEnv, num_envs=2)])
def test_copies_continue_the_episode(make, duplicate):
    envs = [make("psy")]
    envs[0].reset(seed=1)
    actions = [envs[0].action_space.sample() for _ in range(60)]
    for action in actions[:3]:
        envs[0].step(action)
    envs.append(duplicate(envs[0]))
    for action in actions:
        np.testing.assert_array_equal(*(env.step(action)[0] for env in envs))
    np.testing.assert_array_equal(*(env.reset()[0] for env in envs))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task_set": "nonesuch"}, "unknown task set 'nonesuch'; allowed"),
        ({"render_mode": "human"}, "one of rgb_array, ansi, got 'human'"),
        ({"num_envs": 0}, "num_envs must be an integer >= 1, got 0"),
        ({"cell_size": 0}, "cell_size must be an integer >= 1, got 0"),
        ({"max_episode_steps": 0}, "max_episode_steps must be an integer >= 1, got 0"),
        ({"autoreset_mode": "Disabled"}, "one of NextStep, SameStep, got 'Disabled'"),
        ({"task_set": tt.Environment(), "max_steps": 9}, "do not apply"),
    ],
)
def test_invalid_arguments_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        TrapTubeVectorEnv(**options)


def test_invalid_actions_are_refused(easy_env):
    flat = TrapTubeEnv(easy_env, flat_actions=True)
    pairs = TrapTubeVectorEnv(easy_env, 2)
    for env, allowed, refused in (
        (flat, 0, [(action, "actions must") for action in (16, -1, 1.5, [0, 1], "up")]),
        (
            pairs,
            [[0, 0], [0, 0]],
            [
                ([0, 0], r"shape \(2, 2\), got int64 of"),
                ([[0, 0], [0, 4]], "from 0 to 3"),
                ((np.zeros((2, 2), int), None), "rectangular"),  # an action and a state
            ],
        ),
    ):
        with pytest.raises(gymnasium.error.ResetNeeded):
            env.step(allowed)
        env.reset(seed=0)
        for action, message in refused:
            with pytest.raises(ValueError, match=message):
                env.step(action)
