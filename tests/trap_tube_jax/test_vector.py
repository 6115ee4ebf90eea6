"""The fast path against its plain reference, `jax.vmap` of an `AutoReset`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from helpers.refusal import assert_refused
from helpers.trees import assert_same
from trap_tube_jax import vector
from trap_tube_jax.adapters.next_step import NextStepVectorEnvironment
from trap_tube_jax.vector import draw_movable, draw_static

OPTIMISED = False  # few environments, few steps
NUM_ENVS = 24
NUM_STEPS = 16
MAX_STEPS = 5


def rollout(reset, step):
    """Runs fixed actions through an environment of NUM_ENVS and returns all it says."""
    keys = jax.random.split(jax.random.key(3), NUM_ENVS)
    actions = jax.random.randint(jax.random.key(4), (NUM_STEPS, NUM_ENVS, 2), 0, 4)
    state, first = reset(keys)
    state, timesteps = jax.lax.scan(step, state, actions)
    return state, first, timesteps


def stagger(episodes):
    """The same episodes at different times, so that only some end together."""
    time = jnp.arange(NUM_ENVS, dtype=jnp.int32) % MAX_STEPS
    return episodes.replace(inner=episodes.inner.replace(time=time))


def run_fast(env):
    fast = tt.VectorEnvironment(env)

    def reset(keys):
        state, timestep = fast.reset(keys)
        return state.replace(episodes=stagger(state.episodes)), timestep

    state, first, timesteps = jax.jit(lambda: rollout(reset, fast.step))()
    return state.episodes, first, timesteps


def run_plain(env):
    plain = tt.AutoReset(env)

    def reset(keys):
        episodes, timestep = jax.vmap(plain.reset)(keys)
        return stagger(episodes), timestep

    return jax.jit(lambda: rollout(reset, jax.vmap(plain.step)))()


# Random actions solve the second one's task at once or never.
NEAR = tt.State.from_ascii(["AF.........T", *["." * 12] * 11])
ENVIRONMENTS = [
    (tt.make("pstsy", max_steps=MAX_STEPS), 3, "threefry2x32"),
    (tt.Environment((tt.structural,), base=NEAR, max_steps=MAX_STEPS), 32, "unsafe_rbg"),
    (tt.make("base", num_features=1, max_steps=MAX_STEPS), 1, "threefry2x32"),
]


@pytest.mark.parametrize(("env", "chunk_size", "impl"), ENVIRONMENTS)
def test_a_batch_equals_vmap_of_auto_reset_in_every_bit(env, chunk_size, impl, monkeypatch):
    monkeypatch.setattr(vector, "MIN_CHUNK", chunk_size)
    with jax.default_prng_impl(impl):
        fast = run_fast(env)
        plain = run_plain(env)
    ends = plain[2].done.sum(axis=1)
    assert 0 < ends.min(), "every step must end some episode"
    assert ends.max() < NUM_ENVS, "no step may end all"
    assert (plain[2].terminated.sum() > 9) == (env.base == NEAR)
    assert_same(fast, plain)


@pytest.mark.parametrize(("backend", "size"), [("cpu", 32), ("gpu", 64)])
def test_more_environments_start_over_at_once_on_other_devices_than_a_cpu(
    backend, size, monkeypatch
):
    """By the number of tasks that a transfer draws at once."""
    sizes = set()

    @jax.custom_batching.custom_vmap
    def identity(key):
        return key

    @identity.def_vmap
    def _(axis_size, in_batched, key):
        sizes.add(axis_size)
        return key, in_batched[0]

    def recolor(key, state):
        return tt.structural(identity(key), state)

    batch = tt.VectorEnvironment(tt.Environment((recolor,)))
    state, _ = jax.eval_shape(batch.reset, jax.random.split(jax.random.key(0), 2048))
    sizes.clear()
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    jax.eval_shape(batch.step, state, jnp.zeros((2048, 2), jnp.int32))
    assert sizes == {size}


@pytest.mark.parametrize("num_features", [2, 3, 9])
def test_a_picture_drawn_in_two_layers_equals_the_observation(num_features):
    env = tt.make("pstsy", num_features=num_features)
    keys = jax.random.split(jax.random.key(num_features), 32)
    state, timestep = jax.jit(jax.vmap(env.reset))(keys)
    drawn = jax.jit(jax.vmap(lambda s: draw_movable(s, draw_static(s))))(state)
    np.testing.assert_array_equal(drawn.reshape(timestep.observation.shape), timestep.observation)


def test_a_batch_of_other_environments_is_refused():
    for other in (tt.AutoReset(tt.make("base")), None):
        assert_refused(["must be a trap_tube_jax.Environment"], tt.VectorEnvironment, other)
    words = ["jax.vmap(AutoReset(env).step) steps a subclass"]
    assert_refused(words, tt.VectorEnvironment, type("Own", (tt.Environment,), {})())


def test_raw_keys_draw_the_same_tasks():
    batch = tt.VectorEnvironment(tt.make("p"))
    keys = jax.random.split(jax.random.key(0), 3)
    (_, typed), (_, raw) = map(batch.reset, (keys, jax.random.key_data(keys)))
    assert_same(typed, raw)


def test_a_batch_refuses_a_single_key_and_other_states():
    batch = tt.VectorEnvironment(tt.make("base"))
    keys = jax.random.split(jax.random.key(0), 3)
    raw = np.zeros((3, 2), np.int32)
    for key in (keys[0], jax.random.PRNGKey(0), 0, None, "keys", keys[:0], list(keys), raw):
        assert_refused(["PRNG keys [B]", "jax.random.split"], batch.reset, key)
    state, timestep = jax.eval_shape(batch.reset, keys)
    actions = np.zeros((3, 2), np.int32)
    words = ["VectorState, got AutoResetTimeStep", "return (state, timestep)"]
    for either in (batch, NextStepVectorEnvironment(tt.make("base"))):
        assert_refused(words, either.step, timestep, actions)
    assert_refused(["integer[3, 2]", "int32[2, 2]"], batch.step, state, actions[:2])
