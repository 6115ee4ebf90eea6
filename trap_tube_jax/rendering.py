"""Pictures for people: the board with a sign on every object, and animated GIFs.

The agent sees plain colours (`trap_tube_jax.observation`), which may collide under the
structural transfer. A picture therefore marks every object with a sign in black or
white, the one with more contrast to the object's colour:

    trap: a cross            exit: a ring            ground: nothing
    tube1, tube2: hatching that rises to the right, to the left
    food: an apple           tool: a bar along it    agent: a face
"""

import functools
import numbers
import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from trap_tube_jax.checks import check_integer, describe_array, expand, integer_array
from trap_tube_jax.dynamics import holds_tool, step
from trap_tube_jax.environment import check_actions
from trap_tube_jax.geometry import unit_vector
from trap_tube_jax.imports import needs_extra
from trap_tube_jax.objects import (
    AGENT,
    BOARD_SIZE,
    EXIT,
    FOOD,
    GROUND,
    LUMA,
    NO_DIRECTION,
    NUM_DIRECTIONS,
    NUM_OBJECTS,
    TOOL,
    TRAP,
    TUBE1,
    TUBE2,
)
from trap_tube_jax.observation import observe, visible_objects
from trap_tube_jax.state import State, check_state

MIN_SIGN_SIZE = 7  # the smallest cell, in pixels, with a sign
MIN_GRID_SIZE = 4  # the smallest cell, in pixels, with lines around it
SIGN_OPACITY = 0.8
GRID_OPACITY = 0.22
TOOL_BAR_RADIUS = 0.16  # in cells, like the next two
TOOL_BAR_OVERHANG = 0.18  # beyond the centres of the outer cells
HAND_RADIUS = 0.2
FPS_RANGE = (1, 50)  # browsers slow down GIFs with shorter frames


def render(
    state: State,
    cell_size: int = 32,
    *,
    grid: bool = True,
    grasp: jax.Array | int | None = None,
) -> jax.Array:
    """Draws the board as an RGB picture. Pure; jit and vmap it.

    One feature channel is shown as grey, two as red and green, three or more as red, green and
    blue by the first three. Cells below 7 pixels have no signs and no hand, cells below 4 no
    lines. With one pixel per cell the picture is the observation in RGB.

    Args:
      state: one unbatched state.
      cell_size: s >= 1, pixels per cell and side.
      grid: whether to draw lines between the cells.
      grasp: i32[], direction of the agent's hand (0 up, 1 down, 2 left, 3 right). A hand that
        holds the tool is a disc, an empty one a ring. None and other numbers draw no hand.

    Returns:
      u8[12 s, 12 s, 3].

    Raises:
      ValueError: `cell_size` is not an integer >= 1, `grasp` not one integer, or `state` not one
        unbatched state.

    Example:
      >>> picture = tt.render(tt.base_state(), 32, grasp=0)
      >>> picture.shape, picture.dtype
      ((384, 384, 3), dtype('uint8'))
    """
    check_state(state)
    cell_size = check_integer("cell_size", cell_size)
    if grasp is not None and integer_array("grasp", grasp).shape:
        raise ValueError(f"grasp must be one integer, got {grasp!r}")
    return _render(state, grasp, cell_size=cell_size, grid=bool(grid))


def used_window(states: State, cell_size: int) -> tuple[slice, slice]:
    """Returns the part of pictures of B states that shows their objects, with a margin of a cell.

    The slices are of the rows and columns of pixels that `render` draws with `cell_size`.
    """
    is_used = np.asarray(jax.vmap(visible_objects)(states)) != GROUND

    def part(along: np.ndarray) -> slice:
        cells = np.flatnonzero(along)
        return slice(max(cells[0] - 1, 0) * cell_size, (cells[-1] + 2) * cell_size)

    return part(is_used.any(axis=(0, 2))), part(is_used.any(axis=(0, 1)))


def rgb(features: jax.Array) -> jax.Array:
    """Returns the colours u8[..., 3] in which `render` shows features u8[..., N]."""
    num_features = features.shape[-1]
    if num_features == 1:
        return jnp.repeat(features, 3, axis=-1)
    if num_features == 2:
        return jnp.pad(features, [*[(0, 0)] * (features.ndim - 1), (0, 1)])
    return features[..., :3]


def episode_frames(state: State, actions: Any, cell_size: int = 20) -> np.ndarray:
    """Draws an episode as u8[T + 1, 12 s, 12 s, 3], without a step limit. Runs on the host.

    A frame shows the board before an action, with the hand in the action's grasp direction. The
    last frame shows the final board without a hand.

    Args:
      state: one unbatched state.
      actions: i32[T, 2], (grasp, move) pairs, each 0 up, 1 down, 2 left, 3 right; or (-1, -1),
        the padding of a `Plan`, which moves nothing. T may be 0.
      cell_size: s >= 1, pixels per cell and side.

    Raises:
      ValueError: an argument is invalid; the message says what is allowed.

    Example:
      >>> state = tt.base_state()
      >>> frames = tt.episode_frames(state, tt.solve(state).actions)
      >>> frames.shape
      (12, 240, 240, 3)
    """
    check_state(state)
    cell_size = check_integer("cell_size", cell_size)
    if isinstance(actions, list | tuple) and not actions:
        actions = np.zeros((0, 2), np.int32)
    actions = np.atleast_1d(integer_array("action", actions))
    is_padding = (actions == NO_DIRECTION).all(axis=-1, keepdims=True)
    check_actions(np.where(is_padding, 0, actions), (len(actions), 2))
    return np.asarray(_episode_frames(state, actions.astype(np.int32), cell_size=cell_size))


def save_gif(frames: Any, path: str | os.PathLike[str], fps: float = 8) -> None:
    """Writes an endlessly looping GIF, whose last frame stays a second longer. Runs on the host.

    Args:
      frames: u8[T, height, width, 3], or a sequence of T pictures; T >= 1. Pictures of at most
        256 colours are stored exactly.
      path: the file to write.
      fps: frames per second, 1 to 50. A frame takes whole hundredths of a second, as GIF counts.

    Raises:
      ValueError: an argument is invalid; the message says what is allowed.
      ImportError: pillow is not installed.

    Example:
      >>> state = tt.base_state()
      >>> frames = tt.episode_frames(state, tt.solve(state).actions)
      >>> tt.save_gif(frames, "plan.gif", fps=4)
    """
    allowed = "frames must be uint8[T, height, width, 3], each at least 1"
    try:
        pictures = np.asarray(frames)
    except ValueError as error:
        raise ValueError(f"{allowed}: {error}") from error
    shape = pictures.shape
    if pictures.dtype != np.uint8 or len(shape) != 4 or 0 in shape or shape[-1] != 3:
        raise ValueError(f"{allowed}, got {describe_array(pictures)}")
    if not isinstance(fps, numbers.Real) or not FPS_RANGE[0] <= fps <= FPS_RANGE[1]:
        raise ValueError(f"fps must be from {FPS_RANGE[0]} to {FPS_RANGE[1]}, got {fps!r}")
    with needs_extra("pictures"):
        from PIL import Image  # noqa: PLC0415  importing the environment must stay light

    durations = [10 * round(100 / fps)] * len(pictures)  # milliseconds
    durations[-1] += 1000
    first, *rest = map(Image.fromarray, pictures)
    options: dict[str, Any] = {"save_all": True, "append_images": rest, "optimize": True}
    first.save(expand(path), format="GIF", duration=durations, loop=0, **options)


@functools.partial(jax.jit, static_argnames="cell_size")
def _episode_frames(state: State, actions: jax.Array, *, cell_size: int) -> jax.Array:
    actions = jnp.pad(actions, ((0, 1), (0, 0)), constant_values=NO_DIRECTION)

    def body(state: State, action: jax.Array) -> tuple[State, jax.Array]:
        return step(state, action), render(state, cell_size, grasp=action[0])

    return jax.lax.scan(body, state, actions)[1]


@functools.partial(jax.jit, static_argnames=("cell_size", "grid"))
def _render(
    state: State, grasp: jax.Array | int | None, *, cell_size: int, grid: bool
) -> jax.Array:
    objects = visible_objects(state)
    image = _enlarge(rgb(observe(state)), cell_size).astype(jnp.float32)
    ink = _ink(image)
    if cell_size >= MIN_SIGN_SIZE:
        is_tool = _enlarge(objects, cell_size) == TOOL
        sign = jnp.where(is_tool, _tool_bar(state, cell_size), _arrange(_signs(cell_size), objects))
        image = _blend(image, ink, sign * SIGN_OPACITY)
    if grid and cell_size >= MIN_GRID_SIZE:
        image = _blend(image, ink, _grid_lines(cell_size) * GRID_OPACITY)
    if grasp is not None and cell_size >= MIN_SIGN_SIZE:
        image = _draw_hand(image, state, jnp.asarray(grasp), cell_size)
    return jnp.round(image).astype(jnp.uint8)


def _enlarge(cells: jax.Array, cell_size: int) -> jax.Array:
    """Repeats every cell of [12, 12, ...] s times down and across."""
    return jnp.repeat(jnp.repeat(cells, cell_size, axis=0), cell_size, axis=1)


def _arrange(tiles: np.ndarray, objects: jax.Array) -> jax.Array:
    """Lays out tiles [8, s, s] by the objects u8[12, 12] of the cells, as [12 s, 12 s]."""
    size = BOARD_SIZE * tiles.shape[-1]
    return jnp.asarray(tiles)[objects].transpose(0, 2, 1, 3).reshape(size, size)


def _ink(color: Any) -> Any:
    """Returns black or white f32[h, w, 1], the one with more contrast to f32[h, w, 3]."""
    is_dark = color @ LUMA.astype(np.float32) < 128
    return 255 * is_dark[..., None].astype(np.float32)


def _blend(image: Any, ink: Any, opacity: Any) -> Any:
    """Lays `ink` over `image` f32[h, w, 3] with opacity f32[h, w] from 0 to 1."""
    return image + (ink - image) * opacity[..., None]


# A sign is a signed distance field over pixel centres, in units of a cell: negative
# inside the shape. A ramp of one pixel at its edge keeps it smooth at every size.


@functools.cache
def _signs(cell_size: int) -> np.ndarray:
    """Returns the fraction of every pixel that a sign covers, f32[8, s, s]. The tool has none."""
    y, x = _offsets((0.5, 0.5), 1, cell_size)
    distance = np.full((NUM_OBJECTS, cell_size, cell_size), np.inf, np.float32)
    distance[TRAP] = _cross(y, x)
    distance[EXIT] = abs(np.hypot(y, x) - 0.24) - 0.07
    distance[TUBE1] = _hatching(x + y)
    distance[TUBE2] = _hatching(x - y)
    distance[FOOD] = _apple(y, x)
    distance[AGENT] = _face(y, x)
    return _coverage(distance, cell_size)


def _cross(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    to_diagonals = np.minimum(abs(x - y), abs(x + y)) / np.sqrt(2)
    return np.maximum(to_diagonals - 0.07, np.maximum(abs(x), abs(y)) - 0.29)


def _hatching(across: np.ndarray) -> np.ndarray:
    """Draws two diagonals per cell, which meet the diagonals of neighbouring cells."""
    return abs(2 * across % 1 - 0.5) / np.sqrt(8) - 0.035


def _apple(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    halves = np.hypot(abs(x) - 0.09, y - 0.06) - 0.19
    stem = np.hypot(x - 0.02, np.maximum(abs(y + 0.22) - 0.08, 0)) - 0.035
    return np.minimum(halves, stem)


def _face(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    eyes = np.hypot(abs(x) - 0.15, y + 0.1) - 0.08
    mouth = np.maximum(abs(np.hypot(x, y) - 0.26) - 0.045, 0.1 - y)
    return np.minimum(eyes, mouth)


def _tool_bar(state: State, cell_size: int) -> jax.Array:
    """Draws a bar f32[12 s, 12 s] with round ends along the tool; a single cell is vertical."""
    corner = state.tool.astype(np.float32)
    extent = state.tool_extent.astype(np.float32)
    along = jnp.where(extent[1] > 1, np.array([0, 1], np.float32), np.array([1, 0], np.float32))
    half = (extent - 1) / 2 + TOOL_BAR_OVERHANG * along
    y, x = _offsets(corner + extent / 2, BOARD_SIZE, cell_size)
    outside = [jnp.maximum(abs(y) - half[0], 0), jnp.maximum(abs(x) - half[1], 0)]
    return _coverage(jnp.hypot(*outside) - TOOL_BAR_RADIUS, cell_size)


def _draw_hand(image: jax.Array, state: State, grasp: jax.Array, cell_size: int) -> jax.Array:
    """Draws a white hand with a black outline on the agent's border in the grasp direction."""
    center = state.agent.astype(np.float32) + 0.5 + 0.5 * unit_vector(grasp).astype(np.float32)
    y, x = _offsets(center, BOARD_SIZE, cell_size)
    disc = jnp.hypot(y, x) - HAND_RADIUS
    hand = jnp.where(holds_tool(state, grasp), disc, jnp.abs(disc + 0.07) - 0.07)
    is_shown = (grasp >= 0) & (grasp < NUM_DIRECTIONS)
    hand = jnp.where(is_shown, hand, jnp.inf)
    image = _blend(image, 0.0, _coverage(hand - 0.05, cell_size))
    return _blend(image, 255.0, _coverage(hand, cell_size))


def _offsets(center: Any, num_cells: int, cell_size: int) -> tuple[Any, Any]:
    """Returns the offsets of pixels below and right of `center`, as f32[n s, 1] and f32[1, n s].

    `center`, (y, x), and the offsets are in units of a cell.
    """
    along = (np.arange(num_cells * cell_size, dtype=np.float32) + 0.5) / cell_size
    return (along - center[0])[:, None], (along - center[1])[None, :]


def _coverage(distance: Any, cell_size: int) -> Any:
    """Returns the fraction of a pixel that is inside the shape, 0 to 1, as f32."""
    return (0.5 - distance * cell_size).clip(0, 1)


def _grid_lines(cell_size: int) -> np.ndarray:
    """Returns f32[12 s, 12 s]: 1 on the lines around the cells, 0 elsewhere."""
    width = max(1, cell_size // 32)
    pixels = np.arange(BOARD_SIZE * cell_size)
    on_line = (pixels % cell_size < width) | (pixels >= len(pixels) - width)
    return (on_line[:, None] | on_line).astype(np.float32)
