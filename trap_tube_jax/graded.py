"""The perceptual and the structural transfer at strengths from 0 to 1.

The strength bounds how far a drawn layout may lie from the base task's, and drawn features from
the state's. Strength 0 draws exactly these; strength 1 is the paper's transfer. Draws are nested: a
layout, or a direction of a feature point, that is possible at one strength is possible at every
higher one.

Source: graded.md; the paper, section "Structural", for interpolation on the sphere.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from trap_tube_jax.layouts import (
    NUM_OUTLINES,
    LayoutTables,
    layout_tables,
    pad_rows,
    padded_by_outline,
)
from trap_tube_jax.objects import BOARD_SIZE
from trap_tube_jax.state import State, base_state, check_state
from trap_tube_jax.transfers import (
    Transfer,
    draw_layout,
    perceptual,
    recolor,
    sphere_points,
    structural,
)

MIN_RADIUS = 1e-4  # a smaller one is 0 up to rounding; other features have at least 1 / 255
TOLERANCE = 1e-9  # of a distance, against the rounding of strength * distance


def graded_perceptual(strength: float) -> Transfer:
    """Returns a perceptual transfer that draws no farther from the base task than `strength`.

    Every choice of `perceptual` becomes uniform over its outcomes at a distance
    d <= d_min + strength * (d_max - d_min) from the base task, d_min and d_max being the least
    and the greatest distance among the outcomes of the choice. graded.md, "Layouts", lists the
    choices and their distances.

    Args:
      strength: s, from 0 (the base task's layout) to 1 (`perceptual` itself).

    Returns:
      A transfer (key, state) -> state. It keeps the state's palette, time and flags.

    Raises:
      ValueError: `strength` is not a number from 0 to 1.

    Example:
      >>> env = tt.Environment((tt.graded_perceptual(0.25),))
      >>> state, timestep = env.reset(jax.random.key(0))
      >>> state.agent.tolist()  # of the base task: [9, 1]
      [8, 1]
    """
    strength = _check_strength(strength)
    return perceptual if strength == 1 else GradedPerceptual(strength)


def graded_structural(strength: float) -> Transfer:
    """Returns a structural transfer that takes features part of the way to the drawn ones.

    `structural` draws a point u on the unit sphere for every kind of object. With r b the
    state's features as a point, |b| = 1, and theta the angle between b and u, the new features
    belong to the point

        ((1 - s) r + s) (cos(s theta) b + sin(s theta) t)

    t being the unit vector orthogonal to b in the plane of b and u, on the side of u. The
    direction goes the fraction s of the great circle from b to u. For N = 1, where there is
    no circle, the point is (1 - s) r b + s u; for r = 0, where there is no b, it is s u.

    Args:
      strength: s, from 0 (keeps the palette) to 1 (`structural` itself).

    Returns:
      A transfer (key, state) -> state that changes the palette only.

    Raises:
      ValueError: `strength` is not a number from 0 to 1.

    Example:
      >>> state = tt.graded_structural(0.25)(jax.random.key(0), tt.base_state())
      >>> state.palette[1].tolist()  # the trap was [208, 113, 57]
      [219, 179, 87]
    """
    strength = _check_strength(strength)
    return structural if strength == 1 else GradedStructural(strength)


@dataclasses.dataclass(frozen=True)
class GradedPerceptual:
    """The transfer of `graded_perceptual`, for strengths below 1."""

    strength: float

    def __call__(self, key: jax.Array, state: State) -> State:
        """Draws a layout."""
        return draw_layout(key, state, near_layouts(self.strength))

    @property
    def __name__(self) -> str:
        return f"perceptual {self.strength:g}"


@dataclasses.dataclass(frozen=True)
class GradedStructural:
    """The transfer of `graded_structural`, for strengths below 1."""

    strength: float

    def __call__(self, key: jax.Array, state: State) -> State:
        """Draws a palette."""
        check_state(state)
        # The middle of the interval that floor maps to the feature, so that 0 changes nothing.
        start = (state.palette.astype(jnp.float32) + 0.5) / 255 * 2 - 1
        drawn = sphere_points(key, state.palette.shape[-1])
        return recolor(state, points_between(start, drawn, self.strength))

    @property
    def __name__(self) -> str:
        return f"structural {self.strength:g}"


def points_between(start: jax.Array, end: jax.Array, strength: float) -> jax.Array:
    """Returns the points f32[K, N] of `graded_structural` from `start`, r b, to `end`, u."""
    if start.shape[-1] == 1:
        return (1 - strength) * start + strength * end
    radius = jnp.linalg.norm(start, axis=-1, keepdims=True)
    has_no_direction = radius < MIN_RADIUS
    unit = jnp.where(has_no_direction, end, start / jnp.where(has_no_direction, 1, radius))
    cosine = jnp.sum(unit * end, axis=-1, keepdims=True)
    across = end - cosine * unit
    sine = jnp.linalg.norm(across, axis=-1, keepdims=True)
    angle = strength * jnp.atan2(sine, cosine)
    # Where u is b or -b there is no plane, and `across` is zero.
    direction = jnp.cos(angle) * unit + jnp.sin(angle) * across / jnp.maximum(sine, 1e-12)
    return ((1 - strength) * radius + strength) * direction


@functools.lru_cache(maxsize=64)
def near_layouts(strength: float) -> LayoutTables:
    """Builds the tables of a strength; keeps the last 64."""
    full = layout_tables()
    base = base_state()
    foods = []
    tools = []
    agents = []
    for outline in range(NUM_OUTLINES):
        inside = full.food[outline, : full.num_food[outline]]
        corners = full.tool[outline, : full.num_tools[outline]]
        near_corners = _nearest_cells(corners, base.tool, strength)
        rows = zip(corners, full.agent[outline], full.num_agents[outline], strict=False)
        foods.append(_nearest_cells(inside, base.food, strength))
        tools.append(near_corners)
        agents.append(
            [
                _nearest_cells(cells[:count], base.agent, strength)
                for corner, cells, count in rows
                if corner in near_corners
            ]
        )
    food, num_food = pad_rows(foods)
    tool, num_tools = pad_rows(tools)
    agent, num_agents = padded_by_outline(agents, len(tool[0]))
    near = _is_near(_layout_distances(), strength)
    return full._replace(
        layout=np.argwhere(near).astype(np.int32),
        food=food,
        num_food=num_food,
        tool=tool,
        num_tools=num_tools,
        agent=agent,
        num_agents=num_agents,
    )


def _layout_distances() -> np.ndarray:
    """Counts the cells of board and tool, i64[32, 8], that differ from the base task's.

    Tools are compared with their top-left cells aligned.
    """
    full = layout_tables()
    base = base_state()
    board = np.asarray(base.board).reshape(-1)
    board_cells = np.sum(full.board != board, axis=-1)
    extent = np.asarray(base.tool_extent)
    shared = np.minimum(full.extent, extent).prod(axis=1)
    tool_cells = full.extent.prod(axis=1) + extent.prod() - 2 * shared
    return board_cells + tool_cells[:, None]


def _nearest_cells(cells: np.ndarray, target: Any, strength: float) -> np.ndarray:
    """Returns the flat indices near the cell `target`, by steps up, down and across."""
    position = np.stack(np.divmod(cells.astype(np.int32), BOARD_SIZE), axis=-1)
    distance = abs(position - np.asarray(target)).sum(axis=-1)
    return cells[_is_near(distance, strength)]


def _is_near(distance: np.ndarray, strength: float) -> np.ndarray:
    """Tests distances <= d_min + strength * (d_max - d_min), elementwise."""
    nearest = distance.min()
    farthest = distance.max()
    return distance <= nearest + strength * (farthest - nearest) + TOLERANCE


def _check_strength(strength: Any) -> float:
    if isinstance(strength, Tracer):
        raise ValueError(
            "strength must be a number from 0 to 1, got a traced array; make the transfer outside "
            "of jit and vmap"
        )
    number = np.asarray(strength)
    if number.ndim or number.dtype.kind not in "iuf" or not 0 <= number <= 1:
        raise ValueError(f"strength must be a number from 0 to 1, got {strength!r}")
    return float(number)
