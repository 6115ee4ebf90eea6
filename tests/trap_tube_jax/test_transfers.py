"""The transfers against their exact distributions, enumerated from environment.md."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import helpers.spec_reference as spec
import trap_tube_jax as tt
from helpers.goodness_of_fit import assert_fits
from helpers.samples import SAMPLES, Layout, draw, flat, read_layouts, tally

SWAPPED = (spec.TOOL, spec.TUBE1, spec.TUBE2, spec.TRAP, spec.EXIT)
# All objects have different colours, the tubes too.
DISTINCT_PALETTE = np.arange(24, dtype=np.uint8).reshape(8, 3)


@pytest.fixture(scope="module")
def drawn() -> Any:
    return draw(tt.perceptual, 1, tt.base_state())


@pytest.fixture(scope="module")
def layout(drawn) -> Layout:
    return read_layouts(drawn)


def _food_chances() -> np.ndarray:
    """[9, 144]: chances of outline and food cell."""
    chances = np.zeros((9, 144))
    for index, (outline, chance) in enumerate(spec.outlines().items()):
        cells = spec.food_cells(outline)
        chances[index, [spec.flat(cell) for cell in cells]] = chance / len(cells)
    return chances


def test_boards_and_food_have_the_specified_distribution(layout):
    chances = np.repeat(_food_chances()[:, None], 8, axis=1) / 8
    counts = tally((9, 8, 144), layout.outline, layout.variant, layout.food)
    assert np.count_nonzero(chances) == 128
    assert np.all(counts[chances > 0] > 0)
    assert_fits(counts, chances)


@pytest.mark.parametrize("thing", ["tool", "agent"])
def test_tool_and_agent_have_the_specified_distribution(layout, thing):
    chances = spec.placements().sum(axis=3 if thing == "tool" else 2)
    counts = tally((9, 2, 144), layout.outline, layout.vertical, getattr(layout, thing))
    assert np.all(counts[chances * SAMPLES > 20] > 0)
    assert_fits(counts, chances)


def test_the_agent_is_uniform_over_the_cells_that_the_tool_leaves(layout):
    """Among the cells left to it in its layout, the agent's is any with equal chance."""
    allowed = spec.placements() > 0
    where = (layout.outline, layout.vertical, layout.tool)
    assert allowed[(*where, layout.agent)].all(), "an agent outside the support"
    ranks = np.cumsum(allowed, axis=3)[(*where, layout.agent)] - 1
    choices = allowed.sum(axis=3)
    chances = np.zeros((145, 145))
    for number, chance in zip(choices.ravel(), spec.placements().sum(axis=3).ravel(), strict=True):
        chances[number, :number] += chance / max(number, 1)
    assert_fits(tally((145, 145), choices[where], ranks), chances)


def test_perceptual_choices_are_independent(layout):
    """Food does not tell where the tool is, nor the openings where the agent is."""
    by_tool_row = spec.placements().sum(axis=3).reshape(9, 2, 12, 12).sum(axis=3)
    given_outline = by_tool_row / by_tool_row.sum(axis=(1, 2), keepdims=True)
    chances = _food_chances()[:, :, None, None] * given_outline[:, None]
    counts = tally((9, 144, 2, 12), layout.outline, layout.food, layout.vertical, layout.tool // 12)
    assert_fits(counts, chances)

    by_agent_column = spec.placements().sum(axis=2).reshape(9, 2, 12, 12).sum(axis=2)
    chances = np.repeat(by_agent_column[:, None], 8, axis=1) / 8
    counts = tally(
        (9, 8, 2, 12), layout.outline, layout.variant, layout.vertical, layout.agent % 12
    )
    assert_fits(counts, chances)


def test_perceptual_keeps_the_palette_and_nothing_of_the_old_layout(drawn):
    other = tt.State.from_ascii(
        ["A" + "." * 11, "." * 11 + "F", "TT" + "." * 10, *["." * 12] * 9],
        palette=DISTINCT_PALETTE,
    )
    from_other = draw(tt.perceptual, 1, other)
    assert np.all(from_other.palette == DISTINCT_PALETTE)
    assert np.all(drawn.palette == spec.BASE_COLORS)
    for name in ("board", "agent", "tool", "tool_extent", "food"):
        np.testing.assert_array_equal(getattr(from_other, name), getattr(drawn, name))


FEATURES = (1, 2, 3, 8)
POINTS_OF = (spec.TOOL, spec.TUBE1, spec.TRAP, spec.EXIT, spec.GROUND)


@functools.cache
def palettes(num_features: int) -> np.ndarray:
    """u8[samples, 8, N] after the structural transfer."""

    def palette_of(key: jax.Array, state: tt.State) -> jax.Array:
        return tt.structural(key, state).palette

    keys = jax.random.split(jax.random.key(2), SAMPLES)
    start = tt.base_state(num_features)
    return np.asarray(jax.jit(jax.vmap(palette_of, (0, None)))(keys, start))


def _points(num_features: int) -> np.ndarray:
    """[samples, 5, N]: the points, as well as their features tell."""
    features = palettes(num_features)[:, POINTS_OF].astype(float)
    if num_features == 1:  # the points -1 and 1 become 0 and 255
        return features / 255 * 2 - 1
    return (features.clip(max=254) + 0.5) / 255 * 2 - 1


@pytest.mark.parametrize("num_features", FEATURES)
def test_structural_features_have_the_distribution_of_the_sphere(num_features):
    """Each coordinate alone, at the resolution of a single feature value."""
    chances = spec.sphere_feature_chances(num_features)
    for code in POINTS_OF:
        for channel in range(num_features):
            counts = np.bincount(palettes(num_features)[:, code, channel], minlength=256)
            if num_features > 1:
                # In float32 a u just below 1 is 1, and 255 its feature instead of 254.
                counts[254] += counts[255]
                counts[255] = 0
            assert_fits(counts, chances)


@pytest.mark.parametrize("num_features", FEATURES)
def test_structural_points_lie_on_the_sphere(num_features):
    """Some point of length 1 has the features of every sample."""
    features = palettes(num_features)[:, POINTS_OF].astype(float)
    low = features / 255 * 2 - 1
    high = ((features + 1) / 255 * 2 - 1).clip(max=1)
    nearest = np.where((low < 0) & (high > 0), 0, np.minimum(abs(low), abs(high)))
    farthest = np.maximum(abs(low), abs(high))
    assert np.all(np.linalg.norm(nearest, axis=-1) < 1 + 1e-6)
    assert np.all(np.linalg.norm(farthest, axis=-1) > 1 - 1e-6)


@pytest.mark.parametrize("num_features", FEATURES)
def test_colours_are_uniform_on_the_sphere(num_features):
    """Mean 0; covariance I / N within a point and 0 between the five points."""
    points = _points(num_features).reshape(SAMPLES, -1)
    five_sigma = 5 / np.sqrt(SAMPLES)
    deviation = np.sqrt(1 / num_features)
    np.testing.assert_array_less(abs(points.mean(axis=0)), five_sigma * deviation)
    error = points.T @ points / SAMPLES - np.eye(5 * num_features) / num_features
    # The fourth moment of one coordinate is 3 / (N (N + 2)), never less than of two.
    deviation = np.sqrt(3 / (num_features * (num_features + 2)))
    np.testing.assert_array_less(abs(error), five_sigma * deviation)


@pytest.mark.parametrize("num_features", FEATURES)
def test_structural_leaves_agent_and_food_and_the_tubes_alike(num_features):
    start = tt.base_state(num_features)
    after = palettes(num_features)
    np.testing.assert_array_equal(after[:, spec.TUBE1], after[:, spec.TUBE2])
    for code in (spec.AGENT, spec.FOOD):
        assert np.all(after[:, code] == np.asarray(start.palette)[code])


def test_structural_changes_the_palette_only():
    start = tt.base_state()
    after = jax.jit(tt.structural)(jax.random.key(0), start)
    assert after != start == after.replace(palette=start.palette)


def _looks(state: tt.State) -> spec.Looks:
    return spec.Looks(*map(np.asarray, (state.board, state.palette, state.tool, state.tool_extent)))


def _assert_is_one_of(drawn: Any, outcomes: list[spec.Looks]) -> np.ndarray:
    """Returns the samples' outcomes i64[n], found by the tool's corner and then compared whole."""
    corners = flat(np.array([outcome.tool for outcome in outcomes]))
    assert len(set(corners.tolist())) == len(outcomes)
    matches = flat(drawn.tool)[:, None] == corners
    assert matches.any(axis=1).all(), "the tool is where environment.md does not allow it"
    which = matches.argmax(axis=1)
    for name, got in zip(spec.Looks._fields, _looks(drawn), strict=True):
        expected = np.array([getattr(outcome, name) for outcome in outcomes])
        np.testing.assert_array_equal(got, expected[which], err_msg=name)
    return which


@pytest.mark.parametrize("palette", [spec.BASE_COLORS, DISTINCT_PALETTE], ids=["base", "distinct"])
def test_the_base_task_has_five_equally_likely_swaps(palette):
    start = tt.base_state().replace(palette=jnp.asarray(palette))
    drawn = draw(tt.symbolic, 4, start)
    outcomes = [spec.swapped(_looks(start), code) for code in SWAPPED]
    assert_fits(np.bincount(_assert_is_one_of(drawn, outcomes), minlength=5), np.full(5, 0.2))
    for name in ("agent", "food", "time", "terminated", "truncated"):
        assert np.all(getattr(drawn, name) == np.asarray(getattr(start, name)))


def test_perceptual_tasks_have_five_equally_likely_swaps(drawn):
    """Only the five specified outcomes, in 512 draws for each of 256 layouts."""
    layouts = 256
    draws = SAMPLES // 256
    starts = jax.tree.map(lambda leaf: leaf[:layouts], drawn)
    starts = starts.replace(palette=np.broadcast_to(DISTINCT_PALETTE, (layouts, 8, 3)))
    keys = jax.random.split(jax.random.key(6), (layouts, draws))
    after = jax.tree.map(
        np.asarray, jax.jit(jax.vmap(jax.vmap(tt.symbolic, (0, None))))(keys, starts)
    )
    counts = np.zeros((layouts, 5))
    for index in range(layouts):
        start, ends = (jax.tree.map(lambda x, i=index: x[i], tree) for tree in (starts, after))
        outcomes = [spec.swapped(_looks(start), code) for code in SWAPPED]
        counts[index] = np.bincount(_assert_is_one_of(ends, outcomes), minlength=5)
    assert_fits(counts, np.full((layouts, 5), 0.2 / layouts))


def test_symbolic_keeps_the_observation(drawn):
    """Cells and colours change roles together, so that every cell keeps its colour."""

    def before_and_after(key, state):
        return tt.observe(state), tt.observe(tt.symbolic(key, state))

    keys = jax.random.split(jax.random.key(12), 4_096)
    starts = jax.tree.map(lambda leaf: leaf[:4_096], drawn)
    before, after = jax.jit(jax.vmap(before_and_after))(keys, starts)
    np.testing.assert_array_equal(before, after)


def test_symbolic_swaps_only_bars_of_one_to_four_cells():
    """On custom boards: not objects of no cell, of five, bent, or in two parts."""
    start = tt.State.from_ascii(
        ["11111......A", "TT..........", *["." * 12] * 8, ".........F..", "..........xx"],
        palette=DISTINCT_PALETTE,
    )
    bent_trap = np.asarray(start.board).copy()
    bent_trap[10, 11] = spec.TRAP  # three cells now; their bar would end in row 12
    last_cell = np.asarray(start.board).copy()
    last_cell[11, 10] = spec.GROUND  # the trap has only the board's last cell
    parted = np.asarray(start.board).copy()
    parted[11, 10:] = spec.GROUND, spec.TRAP
    parted[9, 10] = spec.TRAP
    boards = ((np.asarray(start.board), True), (bent_trap, False), (parted, False))
    for board, fits in (*boards, (last_cell, True)):
        state = start.replace(board=jnp.asarray(board))
        outcomes = [_looks(state)]
        if fits:
            outcomes.append(spec.swapped(outcomes[0], spec.TRAP))
        which = _assert_is_one_of(draw(tt.symbolic, 7, state, 256), outcomes)
        assert set(which.tolist()) == set(range(len(outcomes)))


@pytest.mark.parametrize("covered", ["agent", "food"])
def test_symbolic_puts_no_object_below_agent_or_food(covered):
    start = tt.base_state()
    tool = {"agent": start.agent, "food": start.food}[covered] - jnp.array([3, 0], jnp.int32)
    drawn = draw(tt.symbolic, 7, start.replace(tool=tool), 64)
    np.testing.assert_array_equal(drawn.board, np.broadcast_to(start.board, (64, 12, 12)))
    np.testing.assert_array_equal(drawn.tool, np.broadcast_to(tool, (64, 2)))


def test_compose_applies_from_left_to_right():
    def double(key, state):
        return state.replace(time=state.time * 2)

    def increment(key, state):
        return state.replace(time=state.time + 1)

    start = tt.base_state()
    key = jax.random.key(0)
    assert tt.compose(double, increment)(key, start).time == 1
    assert tt.compose(increment, double)(key, start).time == 2
    assert tt.compose(increment, double, increment)(key, start).time == 3
    jax.tree.map(np.testing.assert_array_equal, tt.compose()(key, start), start)
    assert tt.make("base+p").transfers[0].__name__ == "identity + perceptual"
