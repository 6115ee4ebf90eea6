"""Graded transfers against their exact distributions, enumerated from graded.md."""

import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import helpers.spec_reference as spec
import trap_tube_jax as tt
from helpers.goodness_of_fit import assert_fits
from helpers.paths import ROOT
from helpers.refusal import assert_refused
from helpers.samples import BOARDS, OUTLINES, Layout, draw, read_layouts, tally
from trap_tube_jax.graded import near_layouts, points_between
from trap_tube_jax.layouts import LayoutTables, layout_tables

DRAWS = 2**15
STRENGTHS = (0.3, 0.7)
BASE = jax.tree.map(np.asarray, tt.base_state())
POINTS_OF = (spec.TOOL, spec.TUBE1, spec.TRAP, spec.EXIT, spec.GROUND)


def near(distances: list[int], strength: float) -> np.ndarray:
    """bool[n]: the outcomes no farther than the strength allows."""
    low = min(distances)
    high = max(distances)
    return np.array([distance - low <= strength * (high - low) + 1e-9 for distance in distances])


def near_cells(cells: list[tuple[int, int]], target: Any, strength: float) -> list[tuple[int, int]]:
    steps = [abs(row - target[0]) + abs(column - target[1]) for row, column in cells]
    return [cell for cell, is_near in zip(cells, near(steps, strength), strict=True) if is_near]


@functools.cache
def layout_chances(strength: float) -> np.ndarray:
    """[outline, variant, vertical]: the chances of board and direction of the tool."""
    own_shape = {(row, 0) for row in range(4)}
    distances = []
    chances = []
    for (outline, chance), boards in zip(spec.outlines().items(), BOARDS, strict=True):
        for board in boards:
            for vertical in (False, True):
                shape = spec.tool_cells(outline, vertical, (0, 0))
                distances.append(int(np.sum(board != BASE.board)) + len(shape ^ own_shape))
                chances.append(chance / 16)
    weights = np.array(chances) * near(distances, strength)
    return (weights / weights.sum()).reshape(9, 8, 2)


@functools.cache
def placements(strength: float) -> np.ndarray:
    """[outline, vertical, tool, agent]: the joint chances."""
    table = np.zeros((9, 2, 144, 144))
    by_frame = layout_chances(strength).sum(axis=1)
    for index, outline in enumerate(OUTLINES):
        for vertical in (False, True):
            corners = near_cells(spec.tool_corners(outline, vertical), BASE.tool, strength)
            for corner in corners:
                cells = spec.agent_cells(outline, vertical, corner)
                cells = near_cells(cells, BASE.agent, strength)
                chance = by_frame[index, int(vertical)] / len(corners) / len(cells)
                where = (index, int(vertical), spec.flat(corner), [spec.flat(c) for c in cells])
                table[where] = chance
    return table


def allowed_choices(tables: LayoutTables) -> set[tuple[Any, ...]]:
    """The outcomes of every choice, each with the choices before it."""
    found: set[tuple[Any, ...]] = {("layout", *pair) for pair in tables.layout.tolist()}
    for outline, num_tools in enumerate(tables.num_tools):
        food = tables.food[outline, : tables.num_food[outline]]
        found |= {("food", outline, cell) for cell in food.tolist()}
        for index, corner in enumerate(tables.tool[outline, :num_tools].tolist()):
            agents = tables.agent[outline, index, : tables.num_agents[outline, index]]
            found |= {("agent", outline, corner, cell) for cell in agents.tolist()}
    return found


@functools.cache
def layouts(strength: float) -> Layout:
    return read_layouts(draw(tt.graded_perceptual(strength), 1, tt.base_state(), DRAWS))


@pytest.mark.parametrize("strength", STRENGTHS)
def test_boards_and_food_have_the_specified_distribution(strength):
    drawn = layouts(strength)
    chances = np.zeros((9, 8, 2, 144))
    for index, outline in enumerate(OUTLINES):
        cells = near_cells(spec.food_cells(outline), BASE.food, strength)
        share = layout_chances(strength)[index, ..., None] / len(cells)
        chances[index][..., [spec.flat(cell) for cell in cells]] = share
    counts = tally(chances.shape, drawn.outline, drawn.variant, drawn.vertical, drawn.food)
    assert np.all(counts[chances > 0] > 0)
    assert_fits(counts, chances)


@pytest.mark.parametrize("strength", STRENGTHS)
def test_tool_and_agent_have_the_specified_distribution(strength):
    drawn = layouts(strength)
    chances = placements(strength)
    where = (drawn.outline, drawn.vertical, drawn.tool, drawn.agent)
    assert np.all(chances[where] > 0), "an agent outside the support"
    by_tool = chances.sum(axis=3)
    by_agent = chances.sum(axis=2)
    counts = tally(by_tool.shape, *where[:3])
    assert np.all(counts[by_tool * DRAWS > 20] > 0)
    assert_fits(counts, by_tool)
    assert_fits(tally(by_agent.shape, drawn.outline, drawn.vertical, drawn.agent), by_agent)


def test_a_higher_strength_allows_all_draws_of_a_lower_one():
    strengths = (0.0, STRENGTHS[0], 0.5, STRENGTHS[1], 1.0)
    sets = [allowed_choices(near_layouts(strength)) for strength in strengths]
    assert all(lower < higher for lower, higher in itertools.pairwise(sets))
    assert sets[-1] == allowed_choices(layout_tables())


def test_a_strength_computed_with_rounding_allows_the_same_draws():
    assert 1 - 0.8 < 0.2
    assert allowed_choices(near_layouts(1 - 0.8)) == allowed_choices(near_layouts(0.2))


@pytest.mark.parametrize("strength", [0, 0.25, 0.5, 1])
def test_the_page_states_how_many_outcomes_each_choice_has(strength):
    tables = near_layouts(float(strength))
    frames = np.unique(tables.layout[:, 0])
    agents = np.concatenate([tables.num_agents[i, : tables.num_tools[i]] for i in frames])
    counts = [tables.num_food[frames], tables.num_tools[frames], agents]
    cells = ["–".join(map(str, sorted({found.min(), found.max()}))) for found in counts]
    row = f"| {strength} | {len(tables.layout)} | {' | '.join(cells)} |"
    assert row in (ROOT / "trap_tube_jax" / "graded.md").read_text(encoding="utf-8")


def test_the_ends_are_the_base_task_and_the_papers_transfers():
    assert tt.graded_perceptual(1) is tt.perceptual
    assert tt.graded_structural(1.0) is tt.structural
    other = tt.State.from_ascii(["A" + "." * 11, "TT" + "." * 9 + "F", *["." * 12] * 10])
    drawn = draw(tt.graded_perceptual(0), 2, other, 100)
    for name in ("board", "agent", "tool", "tool_extent", "food"):
        base = getattr(BASE, name)
        np.testing.assert_array_equal(
            getattr(drawn, name), np.broadcast_to(base, (100, *base.shape))
        )


@pytest.mark.parametrize("num_features", [1, 2, 3, 8])
def test_structural_of_strength_0_keeps_every_palette(num_features):
    features = np.arange(256).repeat(num_features).reshape(32, 8, num_features)
    transfer = tt.graded_structural(0)
    for palette in (*features.astype(np.uint8), np.asarray(tt.base_state(num_features).palette)):
        state = tt.base_state(num_features).replace(palette=jnp.asarray(palette))
        drawn = draw(transfer, 3, state, 20)
        np.testing.assert_array_equal(drawn.palette, np.broadcast_to(palette, drawn.palette.shape))


def directions(palette: np.ndarray) -> np.ndarray:
    """Returns the middles f64[..., N] of the intervals of the features, scaled to length 1."""
    points = (palette.astype(float) + 0.5) / 255 * 2 - 1
    return points / np.linalg.norm(points, axis=-1, keepdims=True)


@functools.cache
def palettes(strength: float) -> np.ndarray:
    return draw(tt.graded_structural(strength), 4, tt.base_state(), DRAWS).palette


@pytest.mark.parametrize("strength", STRENGTHS)
@pytest.mark.parametrize("code", POINTS_OF)
def test_colours_turn_by_a_share_of_a_uniform_direction(strength, code):
    """An angle theta from 0 to pi has density sin(theta) / 2, and here it is scaled."""
    origin = directions(BASE.palette[code])
    angles = np.arccos(directions(palettes(strength)[:, code]) @ origin)
    limit = strength * np.pi
    assert angles.max() < limit + 0.02
    edges = np.linspace(0, limit, 11)
    counts = np.histogram(angles.clip(max=limit), edges)[0]
    assert_fits(counts, -np.diff(np.cos(edges / strength)) / 2)


@pytest.mark.parametrize("strength", STRENGTHS)
def test_structural_goes_to_every_side(strength):
    """Around the state's colour, no direction is preferred."""
    origin = directions(BASE.palette[spec.TOOL])
    first = np.linalg.svd(origin[None])[2][1:]  # two vectors orthogonal to it and to one another
    sides = directions(palettes(strength)[:, spec.TOOL]) @ first.T
    turns = np.arctan2(sides[:, 0], sides[:, 1]) / (2 * np.pi) % 1
    assert_fits(np.bincount((turns * 12).astype(int), minlength=12), np.full(12, 1 / 12))


@pytest.mark.parametrize("num_features", [1, 2, 3, 8])
def test_structural_goes_along_the_great_circle(num_features):
    """Linear in the strength: the angle and the distance from the centre."""
    rng = np.random.default_rng(5)
    origin = rng.uniform(-1, 1, (50, num_features))
    drawn = rng.normal(size=(50, num_features))
    drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
    radius = np.linalg.norm(origin, axis=1)
    whole = np.arccos((np.sum(origin * drawn, axis=1) / radius).clip(-1, 1))
    for strength in (0, 0.2, 0.6, 1):
        points = np.asarray(points_between(jnp.asarray(origin), jnp.asarray(drawn), strength))
        if num_features == 1:
            np.testing.assert_allclose(points, origin + strength * (drawn - origin), atol=1e-5)
            continue
        length = np.linalg.norm(points, axis=1)
        np.testing.assert_allclose(length, radius + strength * (1 - radius), atol=1e-5)
        turned = np.arccos((np.sum(origin * points, axis=1) / radius / length).clip(-1, 1))
        rest = np.arccos((np.sum(drawn * points, axis=1) / length).clip(-1, 1))
        np.testing.assert_allclose(turned, strength * whole, atol=2e-3)
        np.testing.assert_allclose(turned + rest, whole, atol=2e-3)


@pytest.mark.parametrize("rounding", [0.0, 6e-8])
def test_structural_goes_straight_from_the_centre(rounding):
    drawn = np.array([[0.6, 0.8, 0], [0, 0, -1]], np.float32)
    points = points_between(jnp.full((2, 3), rounding), jnp.asarray(drawn), 0.25)
    np.testing.assert_allclose(points, drawn / 4, atol=1e-6)


@pytest.mark.parametrize("transfer", [tt.graded_perceptual(0.3), tt.graded_structural(0.3)])
def test_the_same_alone_in_a_batch_and_in_an_environment(transfer):
    env = tt.Environment((transfer,))
    keys = jax.random.split(jax.random.key(6), 64)
    last = jax.random.split(jax.random.key(6), 64)[63]
    assert transfer.__name__.endswith(" 0.3")
    assert repr(env).startswith(f"Environment(transfers=({transfer.__name__})")
    states, _ = jax.jit(jax.vmap(env.reset))(keys)
    one = jax.tree.map(lambda leaf: leaf[63], states)
    assert one == jax.jit(env.reset)(jax.random.clone(last))[0]
    assert one == tt.validate(env.reset(jax.random.clone(last))[0])
    assert one == transfer(jax.random.fold_in(last, 0), tt.base_state())


@pytest.mark.parametrize("factory", [tt.graded_perceptual, tt.graded_structural])
@pytest.mark.parametrize("strength", [-0.1, 1.01, float("nan"), "1", True, None])
def test_other_strengths_are_refused(factory, strength):
    assert_refused(["strength", "from 0 to 1", repr(strength)], factory, strength)


@pytest.mark.parametrize("factory", [tt.graded_perceptual, tt.graded_structural])
def test_a_traced_strength_is_refused(factory):
    words = ["strength", "traced array", "outside of jit"]
    assert_refused(words, jax.jit(lambda x: factory(x).strength), 0.5)


def test_a_strength_may_be_a_scalar_of_any_kind():
    half = tt.graded_perceptual(0.5)
    scalars: list[Any] = [np.float32(0.5), jnp.array(0.5)]
    assert [tt.graded_perceptual(x) for x in scalars] == [half, half]
