"""The contract of `Environment`."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from helpers.easy_task import DOWN, EASY, RIGHT
from helpers.jax_settings import enable_x64
from helpers.refusal import assert_refused
from helpers.trees import assert_same, rows

OPTIMISED = False  # few steps
SETS = ("base", "sy", "pstsy")  # the first draws one task, the second five
BATCH = 4096
STEPS = 4
LIMIT = 3


class Pace(NamedTuple):
    """State and timestep at one time, or with a leading time axis."""

    state: Any
    timestep: tt.TimeStep


def stacked(paces: list[Pace], axis: int = 0) -> Pace:
    return jax.tree.map(lambda *leaves: np.stack(leaves, axis), *paces)


def play(reset: Callable, step: Callable, key: jax.Array, actions: jax.Array) -> list[Pace]:
    """An episode, or a batch of them, step by step."""
    paces = [Pace(*reset(key))]
    for time in range(STEPS):
        paces.append(Pace(*step(paces[-1].state, actions[..., time, :])))
    return paces


class Modes(NamedTuple):
    """One environment under many keys, and the ways to run it."""

    env: tt.Environment
    keys: jax.Array
    actions: jax.Array
    reset: Callable  # jitted and vmapped
    vmapped: Pace  # NumPy arrays [batch, time, ...]


def traced_once(function: Callable, *, batched: bool = False) -> Callable:
    chex.clear_trace_counter()
    function = chex.assert_max_traces(function, n=1)
    return jax.jit(jax.vmap(function) if batched else function)


@pytest.fixture(scope="module", params=SETS)
def modes(request) -> Modes:
    env = tt.make(request.param, max_steps=LIMIT)
    keys = jax.random.split(jax.random.key(0), BATCH)
    actions = jax.random.randint(jax.random.key(1), (BATCH, STEPS, 2), 0, 4)
    reset, step = (traced_once(method, batched=True) for method in (env.reset, env.step))
    vmapped = stacked(play(reset, step, keys, actions), axis=1)
    return Modes(env, keys, actions, reset, vmapped)


def test_episodes_are_the_same_alone_eager_and_in_scanned_slices(modes):
    env = modes.env
    alone = (traced_once(env.reset), traced_once(env.step))
    for (reset, step), index in ((alone, 0), (alone, BATCH - 1), ((env.reset, env.step), 7)):
        paces = play(reset, step, modes.keys[index], modes.actions[index])
        assert_same(stacked(paces), rows(modes.vmapped, index))

    def advance(state, action):
        pace = Pace(*env.step(state, action))
        return pace.state, pace

    def episode(key, actions):
        first = Pace(*env.reset(key))
        return first, jax.lax.scan(advance, first.state, actions)[1]

    scan = traced_once(episode, batched=True)
    for part in np.split(np.arange(BATCH), 2):
        first, rest = scan(modes.keys[part], modes.actions[part])
        assert_same(first, rows(modes.vmapped, (part, 0)))
        assert_same(rest, rows(modes.vmapped, (part, slice(1, None))))


def test_the_same_key_draws_the_same_bits_and_others_other_tasks(modes):
    again = Pace(*modes.reset(modes.keys))
    assert_same(again, rows(modes.vmapped, (slice(None), 0)))
    # A symbolic swap is invisible, so that what is seen does not tell all tasks apart.
    seen = (again.state.board, again.state.palette, again.state.agent)
    tasks = np.unique(np.concatenate([np.reshape(part, (BATCH, -1)) for part in seen], 1), axis=0)
    expected = {(): 1, (tt.symbolic,): 5}.get(modes.env.transfers)
    assert len(tasks) == expected if expected else len(tasks) > 2_000


def test_reset_starts_an_episode(modes):
    state, timestep = rows(modes.vmapped, (slice(None), 0))
    assert not np.any(state.time)
    assert not np.any(timestep.reward)
    assert not np.any(timestep.done)
    assert np.all(timestep.discount == 1)
    for index in range(0, BATCH, 100):
        tt.validate(rows(state, index))


OVER = EASY.replace(time=jnp.int32(1), truncated=jnp.array(True))


@pytest.mark.parametrize(
    ("state", "actions", "expected"),  # per step: reward, terminated, truncated and discount
    [
        (EASY, [RIGHT, RIGHT, DOWN], [(0, 0, 0, 1), (1, 1, 0, 0), (0, 1, 0, 0)]),
        (EASY, [DOWN, RIGHT, RIGHT], [(0, 0, 0, 1), (0, 0, 1, 1), (0, 0, 1, 1)]),
        (OVER, [RIGHT], [(0, 0, 1, 1)]),  # as under a smaller limit
    ],
    ids=["solved at the limit", "truncated", "truncated before"],
)
def test_an_episode_ends_by_success_or_at_its_limit_and_stays_ended(state, actions, expected):
    step = jax.jit(tt.Environment(base=EASY, max_steps=2).step)
    for action, numbers in zip(actions, expected, strict=True):
        before = state
        (state, timestep) = step(state, action)
        flags = (timestep.terminated, timestep.truncated)
        assert (timestep.reward, *flags, timestep.discount) == numbers
        if before.terminated | before.truncated:
            assert_same(state, before)


def test_states_and_environments_may_be_made_within_a_traced_function():
    """A layout written there is a constant, and custom transfers are tried there."""
    made = jax.jit(lambda: tt.Environment(base=tt.base_state()).base.replace(time=jnp.int32(7)))()
    assert made == tt.base_state().replace(time=jnp.int32(7))
    key = jax.random.key(0)
    state = jax.jit(lambda: tt.make("two-traps").reset(jax.random.clone(key))[0])()
    assert state == tt.make("two-traps").reset(key)[0]


@pytest.mark.parametrize("base", [None, tt.base_state()], ids=["absent", "own"])
def test_a_state_may_be_donated(base):
    """Neither the environment nor a timestep holds its arrays."""
    env = tt.Environment(base=base)
    step = jax.jit(env.step, donate_argnums=0)
    if base is not None:
        step(base, np.zeros(2, np.int32))
    for _ in range(2):
        state, timestep = env.reset(jax.random.key(0))
        state, _ = step(state, np.zeros(2, np.int32))
        assert state.time == 1
        assert not timestep.done


def test_an_environment_keeps_its_base_when_the_callers_changes():
    agent = np.array([9, 1], np.int32)
    env = tt.Environment(base=tt.base_state().replace(agent=agent))
    agent[:] = 0
    assert env == tt.Environment(base=tt.base_state())
    assert env.reset(jax.random.key(0))[0].agent.tolist() == [9, 1]


def test_states_of_numpy_arrays_serve_under_vmap_and_jit():
    env = tt.make("base")
    state = tt.base_state()
    host = jax.device_get(state)
    actions = jnp.array([[0, 3], [0, 1]])
    keys = jax.random.split(jax.random.key(0), 2)

    def swap(state, key):
        return tt.symbolic(jax.random.clone(key), state)

    for function, batch in ((env.step, actions), (swap, keys)):
        expected = jax.vmap(function, (None, 0))(state, batch)
        assert_same(jax.vmap(function, (None, 0))(host, batch), expected)
        alone = jax.jit(functools.partial(function, host))(batch[0])
        assert_same(alone, rows(expected, 0))


def test_custom_transfers_apply_in_order():
    """The second puts the agent where the base task has a trap."""

    def clear(key, state):
        del key
        return state.replace(board=jnp.zeros_like(state.board))

    def into_the_tube(key, state):
        del key
        return state.replace(agent=jnp.array([5, 4], jnp.int32))

    env = tt.Environment((clear, into_the_tube), base=tt.base_state(2))
    state, _ = env.reset(jax.random.key(0))
    assert state.agent.tolist() == [5, 4]
    assert state.palette.shape == (8, 2)
    assert repr(env) == "Environment(transfers=(clear, into_the_tube), base=..., max_steps=50)"
    assert "(perceptual + (perceptual, structural))" in repr(tt.make("p+pst"))
    assert_refused(["into_the_tube", "stands on trap"], tt.Environment, (into_the_tube, clear))


@pytest.mark.parametrize("make_key", [jax.random.key, jax.random.PRNGKey], ids=["typed", "raw"])
def test_custom_transfers_get_typed_keys_by_fold_in(make_key):
    """Typed keys, whatever `reset` was given, and those that `compose` promises."""

    def custom(key, state):
        jnp.stack([jax.random.clone(key), jax.random.key(1)])
        jax.lax.cond(state.time == 0, lambda: jax.random.clone(key), lambda: jax.random.key(2))
        return state.replace(agent=jax.random.randint(key, (2,), 8, 12))

    key = make_key(3)
    with jax.debug_key_reuse(False):  # the branches of `cond` read the key
        state, _ = tt.Environment((tt.structural, custom), base=EASY).reset(key)
    expected = jax.random.fold_in(key, 1)
    np.testing.assert_array_equal(state.agent, jax.random.randint(expected, (2,), 8, 12))


def test_an_environment_is_constant():
    """Since compiled programs hold it, and equal ones share them."""
    env = tt.make("p")
    for name in ("max_steps", "base", "transfers"):
        with pytest.raises(AttributeError, match=f"{name} of an environment is constant"):
            setattr(env, name, getattr(env, name))
    assert env.with_max_steps(7) == tt.make("p", max_steps=7) != env == tt.make("p")
    assert_refused(["max_steps", ">= 1", "0"], env.with_max_steps, 0)


def test_action_numbers_are_four_times_grasp_plus_move():
    actions = np.array([(grasp, move) for grasp in range(4) for move in range(4)])
    np.testing.assert_array_equal(tt.action_from_index(np.arange(16)), actions)
    np.testing.assert_array_equal(tt.action_to_index(actions), np.arange(16))
    assert tt.action_from_index(7).tolist() == [1, 3]
    env = tt.Environment()
    assert env.num_actions == 16
    assert (env.action_spec.shape, env.action_spec.minimum, env.action_spec.maximum) == ((2,), 0, 3)


# Numbers that lie in range once their upper bits are lost.
WIDE = [np.array(number) for number in (2**32 + 3, 2**64 - 2**32 + 3, -(2**32) + 3)]


def test_numbers_out_of_range_are_no_directions():
    index = jnp.array([[-1, 16], [99, 15]])
    expected = [[[-1, -1], [-1, -1]], [[-1, -1], [3, 3]]]
    np.testing.assert_array_equal(jax.jit(tt.action_from_index)(index), expected)
    np.testing.assert_array_equal(jax.jit(tt.action_to_index)(index[:, ::-1]), [-1, -1])
    step = jax.jit(tt.Environment().step)
    for number in WIDE:
        np.testing.assert_array_equal(tt.action_from_index(number), [-1, -1])
        assert tt.action_to_index(np.stack([number, 0 * number])) == -1
        with enable_x64(True):
            np.testing.assert_array_equal(jax.jit(tt.action_from_index)(number), [-1, -1])
            state, _ = step(tt.base_state(), np.stack([0 * number, number]))
            np.testing.assert_array_equal(state.agent, tt.base_state().agent)


@pytest.mark.parametrize("value", [None, "right", 1.0, True, [[0], [1, 2]], jax.random.key(0)])
def test_actions_other_than_integers_are_refused(value):
    functions = (
        tt.action_from_index,
        tt.action_to_index,
        lambda action: tt.Environment().step(tt.base_state(), action),
    )
    for function in functions:
        assert_refused(["integers"], function, value)


def broken(**fields: Any) -> tt.Transfer:
    def transfer(key, state):
        del key
        return state.replace(**fields)

    return transfer


def often_invalid(key, state):
    return state.replace(food=jnp.stack([5, jax.random.randint(key, (), 4, 8, jnp.int32)]))


def no_state(key, state):
    del key, state


def one_argument(state):
    return state


def branching(key, state):
    del key
    return state if state.time > 0 else tt.base_state()


def by_mask(key, state):
    del key
    return state.replace(agent=state.board[state.board > 0][:2].astype(jnp.int32))


BAD_ENVIRONMENTS: list[tuple[dict[str, Any], list[str]]] = [
    ({"max_steps": 0}, ["max_steps", ">= 1", "0"]),
    ({"max_steps": 2.5}, ["max_steps", "integer >= 1", "2.5"]),
    ({"max_steps": True}, ["max_steps", "integer >= 1", "True"]),
    ({"max_steps": 10**10}, ["max_steps", "<= 2147483647", "10000000000"]),
    ({"base": "TrapTube-v0"}, ["trap_tube_jax.State", "str"]),
    ({"base": EASY.replace(agent=EASY.food)}, ["share cell (0, 3)", "apart"]),
    ({"base": EASY.replace(time=np.int32(3))}, ["time 3", "allowed: time 0"]),
    ({"transfers": None}, ["transfers", "(key, state) -> state", "None"]),
    ({"transfers": tt.symbolic}, ["transfers", "sequence", "symbolic"]),
    ({"transfers": {tt.symbolic}}, ["transfers", "sequence", "symbolic"]),  # has no order
    ({"transfers": (often_invalid,)}, ["often_invalid", "invalid state", "food at (5, "]),
    ({"transfers": ("symbolic",)}, ["(key, state) -> state", "'symbolic'"]),
    ({"transfers": (no_state,)}, ["no_state", "invalid", "State", "NoneType"]),
    ({"transfers": (broken(time=np.int32(3)),)}, ["transfer must keep time 0", "got time 3"]),
    (
        {"transfers": (broken(palette=np.zeros((8, 4), np.uint8)),)},
        ["must keep", "uint8[8, 3]", "uint8[8, 4]"],
    ),
    ({"transfers": (one_argument,)}, ["one_argument", "a function (key, state) -> state"]),
    ({"transfers": (branching,)}, ["branching", "runs under jax.jit", "TracerBool"]),
    ({"transfers": (by_mask,)}, ["by_mask", "runs under jax.jit", "NonConcreteBooleanIndex"]),
    (
        {"transfers": (broken(agent=jnp.zeros(2, jnp.float32)),)},
        ["invalid", "state.agent", "int32[2]", "float32[2]"],
    ),
]


@pytest.mark.parametrize(("options", "words"), BAD_ENVIRONMENTS)
def test_impossible_arguments_of_an_environment_are_refused(options, words):
    assert_refused(words, tt.Environment, **options)


BAD_ACTIONS: list[tuple[Any, list[str]]] = [
    (3, ["integer[2]", "int64[]", "action_from_index"]),
    (np.zeros((5, 2), np.int32), ["integer[2]", "int32[5, 2]", "jax.vmap"]),
    ((4, 0), ["(4, 0)", "0 up", "3 right"]),
    (jnp.array((0, -1)), ["(0, -1)", "0 up", "3 right"]),
    *((np.stack([0 * wide, wide]), [f"(0, {wide})", "0 up"]) for wide in WIDE),
]


@pytest.mark.parametrize(("action", "words"), BAD_ACTIONS)
def test_invalid_actions_are_refused(action, words):
    assert_refused(words, tt.Environment().step, tt.base_state(), action)
    if np.shape(action) == (2,):
        vector = tt.VectorEnvironment(tt.Environment())
        state, _ = vector.reset(jax.random.split(jax.random.key(0), 2))
        assert_refused(words, vector.step, state, np.stack([np.zeros_like(action), action]))
