"""Effects: changes and grasps that are new to their episode, outside the agent's body."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents import Config
from agents.acting.episodes import Episodes, cells_of
from agents.curiosity import Experience
from agents.curiosity.effects import Effects, new_effects
from trap_tube_jax.objects import DIRECTIONS

STEPS = 40
BATCH = 48


def random_episodes(env: tt.Environment) -> Episodes:
    """Plays with actions that often repeat, so that objects move."""

    def play(key):
        reset_key, action_key, keep_key = jax.random.split(key, 3)
        initial, _ = jax.vmap(env.reset)(jax.random.split(reset_key, BATCH))
        drawn = jax.random.randint(action_key, (STEPS, BATCH, 2), 0, 4)
        keeps = jax.random.bernoulli(keep_key, 0.7, (STEPS, BATCH, 2))

        def step(carry, inputs):
            state, last = carry
            action = jnp.where(inputs[1], last, inputs[0])
            after, timestep = jax.vmap(env.step)(state, action)
            alive = 1.0 - (state.terminated | state.truncated)
            return (after, action), (jax.vmap(cells_of)(after), action, timestep, alive)

        carry = (initial, drawn[0])
        _, (cells, action, timestep, mask) = jax.lax.scan(step, carry, (drawn, keeps))
        cells = jnp.concatenate([jax.vmap(cells_of)(initial)[None], cells])
        steps = (cells, action, timestep.reward, timestep.discount, mask)
        return Episodes(initial, *(x.swapaxes(0, 1) for x in steps))

    return jax.jit(play)(jax.random.key(0))


def read_off(
    boards: np.ndarray, grasps: np.ndarray, ground: np.ndarray, base_color: dict[str, np.ndarray]
) -> np.ndarray:
    """Finds new effects i64[3, T] from one episode's boards u8[T + 1, 12, 12, N] and grasps.

    Assumes that agent and food stand on ground.
    """
    is_agent = np.asarray(np.all(boards == base_color["agent"], axis=-1))
    is_food = np.asarray(np.all(boards == base_color["food"], axis=-1))
    rest = boards.copy()
    rest[is_agent | is_food] = ground
    found = []
    for views in (is_food, rest):
        seen = set()
        new = []
        for view in views:
            new.append(view.tobytes() not in seen)
            seen.add(view.tobytes())
        found.append(new[1:])
    met = set()
    new = []
    for board, body, grasp in zip(boards, is_agent, grasps, strict=False):
        hand = np.argwhere(body)[0] + DIRECTIONS[grasp]
        color = board[tuple(hand)].tobytes() if np.all((hand >= 0) & (hand < 12)) else None
        new.append(color is not None and color not in met)
        met.add(color)
    return np.array([*found, new])


@pytest.mark.parametrize("short", ["base", "pstsy"])
def test_effects_can_be_read_off_the_observations(short):
    env = tt.make(short, max_steps=STEPS)
    episodes = random_episodes(env)
    boards = np.asarray(jax.jit(Episodes.observations)(episodes))
    found = np.asarray(jax.jit(new_effects)(episodes) * episodes.mask[None])
    base_color = {"agent": np.asarray(env.base.palette[7]), "food": np.asarray(env.base.palette[5])}
    checked = 0
    for index in range(BATCH):
        length = int(episodes.length[index])
        if bool(episodes.solved[index]):
            length -= 1  # the agent stands where the food was
        ground = np.asarray(episodes.layout.palette[index, 0])
        grasps = np.asarray(episodes.action[index, :length, 0])
        expected = read_off(boards[index, : length + 1], grasps, ground, base_color)
        np.testing.assert_array_equal(found[:, index, :length], expected)
        checked += expected.sum()
    assert checked > 0


@pytest.fixture
def by_hand() -> Episodes:
    """Builds two episodes from columns of agent, tool and food; the second ends after 2 steps."""
    first = [(0, 1, 5), (0, 2, 5), (1, 1, 5), (1, 2, 6), (2, 3, 5)]
    second = [(0, 4, 7), (1, 4, 7), (1, 5, 8), (1, 6, 9), (1, 7, 10)]
    column = jnp.array([first, second])
    cells = jnp.stack([jnp.zeros_like(column), column], axis=-1).astype(jnp.uint8)
    mask = jnp.array([[1, 1, 1, 1], [1, 1, 0, 0]], jnp.float32)
    layout = jax.tree.map(lambda x: jnp.stack([x, x]), tt.base_state())
    action = jnp.zeros((2, 4, 2), jnp.int32)
    zeros = jnp.zeros((2, 4))
    return Episodes(layout, cells, action, zeros, zeros + 1, mask)


def test_food_and_tool_that_return_are_no_new_effect(by_hand):
    food, tool, _ = np.asarray(new_effects(by_hand) * by_hand.mask[None])
    np.testing.assert_array_equal(tool, [[1, 0, 0, 1], [0, 1, 0, 0]])
    np.testing.assert_array_equal(food, [[0, 0, 1, 0], [0, 1, 0, 0]])


def test_an_effect_pays_the_inverse_of_its_kinds_rate(by_hand):
    curiosity = Effects(Config(reward_ema_decay=0.75))
    nothing: Any = None
    experience = Experience(by_hand, jnp.zeros((2, 5, 0)), *[nothing] * 3)
    pay, memory = curiosity.reward({}, curiosity.memory(), experience)
    np.testing.assert_allclose(memory, [2 / 6, 3 / 6, 0], rtol=1e-6)
    np.testing.assert_allclose(pay, [[2, 0, 3, 2], [0, 5, 0, 0]], rtol=1e-6)
    # Rates above 0 are moving averages.
    _, memory = curiosity.reward({}, jnp.array([0.5, 0.1, 0.2]), experience)
    expected = [0.75 * 0.5 + 0.25 / 3, 0.75 * 0.1 + 0.25 / 2, 0.75 * 0.2]
    np.testing.assert_allclose(memory, expected, rtol=1e-6)
    # The rarest effects pay 10,000.
    still = Effects(Config(reward_ema_decay=1.0))
    pay, _ = still.reward({}, jnp.array([2e-3, 1e-5, 0.2]), experience)
    np.testing.assert_allclose(pay, [[1e4, 0, 500, 1e4], [0, 1e4 + 500, 0, 0]], rtol=1e-5)
