"""The eight symmetries of the board."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents.acting.rollout import cells_of, place
from agents.config import Config
from agents.dagger.learner import Dataset
from agents.dagger.symmetry import NUM_SYMMETRIES, Symmetry

NUMBERS = range(NUM_SYMMETRIES)


@pytest.fixture(scope="module")
def states() -> tt.State:
    """States on the way of random episodes of {P, St, Sy}, [T, B]."""
    env = tt.make("pstsy")
    state, _ = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 64))

    def step(state, key):
        action = jax.random.randint(key, (64, 2), 0, 4)
        return jax.vmap(env.step)(state, action)[0], state

    return jax.jit(lambda: jax.lax.scan(step, state, jax.random.split(jax.random.key(1), 20))[1])()


def image(symmetry: Symmetry, states: tt.State) -> tt.State:
    """The images of states [B]."""
    layout = symmetry.layout(states)
    cells = symmetry.cells(cells_of(states)[None], states.tool_extent)[0]
    return jax.vmap(place)(layout, cells)


def drawn(symmetry: Symmetry, boards: np.ndarray) -> np.ndarray:
    """The images of pictures [B, 12, 12, N]."""
    if symmetry.transposed:
        boards = boards.swapaxes(1, 2)
    if symmetry.top_down:
        boards = boards[:, ::-1]
    return boards[:, :, ::-1] if symmetry.left_right else boards


@pytest.mark.parametrize("number", NUMBERS)
def test_the_image_looks_like_the_mirrored_picture(states, number):
    symmetry = Symmetry.of(jnp.asarray(number))
    some = jax.tree.map(lambda x: x[10], states)
    found = jax.vmap(tt.observe)(image(symmetry, some))
    expected = drawn(symmetry, np.asarray(jax.vmap(tt.observe)(some)))
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("number", NUMBERS)
def test_the_rules_are_the_same_in_the_image(states, number):
    """Acting and mirroring, and mirroring and acting the mirrored way, come to the same."""
    symmetry = Symmetry.of(jnp.asarray(number))
    env = tt.Environment()
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), states)
    actions = tt.action_from_index(jnp.arange(len(flat.time)) % 16)

    def both(flat):
        after, _ = jax.vmap(env.step)(flat, actions)
        mirrored, _ = jax.vmap(env.step)(image(symmetry, flat), symmetry.directions()[actions])
        return image(symmetry, after), mirrored

    one, other = jax.jit(both)(flat)
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_the_eight_differ_and_the_first_changes_nothing(states):
    some = jax.tree.map(lambda x: x[3], states)
    boards = [
        np.asarray(jax.vmap(tt.observe)(image(Symmetry.of(jnp.asarray(number)), some)))
        for number in NUMBERS
    ]
    np.testing.assert_array_equal(boards[0], jax.vmap(tt.observe)(some))
    assert len({board.tobytes() for board in boards}) == NUM_SYMMETRIES


@pytest.mark.parametrize("number", NUMBERS)
def test_a_dataset_is_mirrored_as_a_whole(states, number):
    """What is right in an image is what is right, mirrored."""
    symmetry = Symmetry.of(jnp.asarray(number))
    config = Config.preset("best", tasks=32, episodes=64, dataset=64, max_steps=19, walk_steps=19)
    rng = np.random.default_rng(number)
    right = rng.integers(0, 2**16, (19, 64)).astype(np.uint16)
    layout = jax.tree.map(lambda x: x[0], states)
    dataset = Dataset.empty(config, tt.base_state())._replace(
        layout=layout,
        cells=jax.vmap(cells_of)(states),
        action=jnp.asarray(rng.integers(0, 4, (19, 64, 2)), jnp.uint8),
        right=jnp.asarray(right),
        known=jnp.asarray(~right),
    )
    found = dataset.mirrored(symmetry)
    directions = np.asarray(symmetry.directions())
    np.testing.assert_array_equal(found.action, directions[np.asarray(dataset.action)])
    for action in range(16):
        grasp, move = directions[action // 4], directions[action % 4]
        there = (np.asarray(found.right) >> (4 * grasp + move)) & 1
        np.testing.assert_array_equal(there, (right >> action) & 1)
    np.testing.assert_array_equal(found.known, ~np.asarray(found.right))
    last = jax.vmap(place)(found.layout, found.cells[-1])
    expected = image(symmetry, jax.tree.map(lambda x: x[-1], states))
    np.testing.assert_array_equal(jax.vmap(tt.observe)(last), jax.vmap(tt.observe)(expected))
