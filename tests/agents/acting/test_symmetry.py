"""The eight symmetries of the board, and the one that puts the food ahead."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents.acting.symmetry import Symmetry
from trap_tube_jax.objects import AGENT, FOOD

NUM_SYMMETRIES = 8
NUMBERS = range(NUM_SYMMETRIES)


@pytest.fixture(scope="module")
def states() -> tt.State:
    """Plays {P, St, Sy} at random for 20 steps; returns the states [B]."""
    env = tt.make("pstsy")
    state, _ = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 256))

    def step(state, key):
        action = jax.random.randint(key, (256, 2), 0, 4)
        return jax.vmap(env.step)(state, action)[0], None

    return jax.jit(lambda: jax.lax.scan(step, state, jax.random.split(jax.random.key(1), 20))[0])()


@pytest.fixture(scope="module")
def images(states) -> tt.State:
    """The image of every state under every symmetry, [8, B]."""
    turn = jax.vmap(lambda symmetry, state: symmetry.transform_state(state), in_axes=(None, 0))
    return jax.jit(jax.vmap(turn, in_axes=(0, None)))(
        Symmetry.from_index(jnp.arange(NUM_SYMMETRIES)), states
    )


def mirrored(number: int, pictures: np.ndarray) -> np.ndarray:
    """The images of pictures [B, 12, 12, N]."""
    if number % 2:
        pictures = pictures.swapaxes(1, 2)
    if number // 2 % 2:
        pictures = pictures[:, ::-1]
    return pictures[:, :, ::-1] if number // 4 else pictures


def one_of(images: tt.State, number: int) -> tt.State:
    return jax.tree.map(lambda x: x[number], images)


@pytest.mark.parametrize("number", NUMBERS)
def test_an_image_looks_like_the_mirrored_picture(states, images, number):
    observe = jax.jit(jax.vmap(tt.observe))
    expected = mirrored(number, np.asarray(observe(states)))
    found = observe(one_of(images, number))
    np.testing.assert_array_equal(found, expected)
    pictures = jax.vmap(Symmetry.from_index(jnp.asarray(number)).transform_board)(observe(states))
    np.testing.assert_array_equal(pictures, expected)


def test_the_rules_are_the_same_in_an_image(states, images):
    """A step in an image has the result of the original action, mirrored."""
    env = tt.Environment()
    actions = tt.action_from_index(jnp.arange(len(states.time)) % 16)

    @jax.jit
    def both(states, images):
        def turned_step(number, turned):
            symmetry = Symmetry.from_index(number)
            after, _ = jax.vmap(env.step)(states, symmetry.original_action(actions))
            return jax.vmap(symmetry.transform_state)(after), jax.vmap(env.step)(turned, actions)[0]

        return jax.vmap(turned_step)(jnp.arange(NUM_SYMMETRIES), images)

    expected, found = both(states, images)
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_a_state_and_its_images_are_equal_once_turned_to_the_food(states, images):

    def seen(state):
        symmetry = Symmetry.facing_food(tt.observe(state))
        return symmetry.transform_state(state)

    turned = jax.jit(jax.vmap(jax.vmap(seen)))(images)
    offset = np.asarray(turned.food - turned.agent)
    assert np.all(offset >= 0)
    assert np.all(offset[..., 0] >= offset[..., 1])
    # On an axis or a diagonal of the board two images face the food.
    unique = (offset[0, :, 0] > offset[0, :, 1]) & (offset[0, :, 1] > 0)
    assert 0.5 < unique.mean() < 1
    boards = np.asarray(jax.vmap(jax.vmap(tt.observe))(turned))
    np.testing.assert_array_equal(
        boards[:, unique], np.repeat(boards[:1, unique], NUM_SYMMETRIES, 0)
    )


@pytest.mark.parametrize("hidden", [AGENT, FOOD])
def test_the_symmetry_is_the_identity_where_agent_or_food_is_hidden(hidden):
    shown = tt.base_state().palette[AGENT + FOOD - hidden]
    board = jnp.zeros((12, 12, 3), jnp.uint8).at[2, 7].set(shown)
    assert not any(bool(part) for part in Symmetry.facing_food(board))
