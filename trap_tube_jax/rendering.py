"""Pictures for people: the board with a sign on every object, and animated GIFs.

The agent sees plain colours (`trap_tube_jax.observation`), which may collide under the
structural transfer. A picture therefore marks every object with a sign in black or
white, whichever stands out from the object's colour:

    trap: a cross            exit: a ring            ground: nothing
    tube1, tube2: hatching that rises to the right, to the left
    food: an apple           tool: a bar along it    agent: a face
"""

import functools
import itertools
import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from trap_tube_jax.checks import check_integer
from trap_tube_jax.dynamics import holds_tool, step
from trap_tube_jax.geometry import unit_vector
from trap_tube_jax.objects import (
    AGENT,
    BASE_COLORS,
    BOARD_SIZE,
    EXIT,
    FOOD,
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
from trap_tube_jax.state import State

SMALLEST_SIGN = 7  # the smallest cell, in pixels, with a sign
SMALLEST_GRID = 4  # the smallest cell, in pixels, with lines around it
SIGN_OPACITY = 0.8
GRID_OPACITY = 0.22
TOOL_BAR_RADIUS = 0.16  # in cells, like the next two
TOOL_BAR_OVERHANG = 0.18  # beyond the centres of the outer cells
HAND_RADIUS = 0.2
MAX_FPS = 50  # browsers slow down GIFs with shorter frames
LONGEST_FRAME = 655.35  # seconds, what a GIF can hold


def render(
    state: State,
    cell_size: int = 32,
    *,
    grid: bool = True,
    grasp: jax.Array | int | None = None,
) -> jax.Array:
    """The board as an RGB picture. Pure, jit- and vmap-able.

    One feature channel is shown as grey, two as red and green, of three and more the
    first three as red, green and blue. Cells below 7 pixels carry no signs and no hand,
    below 4 no lines: one pixel per cell is the observation itself, in RGB.

    Args:
      state: one unbatched state.
      cell_size: s >= 1, pixels per cell and side.
      grid: whether to draw lines between the cells.
      grasp: i32[], a direction (0 up, 1 down, 2 left, 3 right) to draw the agent's hand
        in: a disc where it holds the tool, a ring where it is empty. None and any other
        number draw no hand.

    Returns:
      u8[12 s, 12 s, 3].

    Raises:
      ValueError: `cell_size` is not an integer >= 1.
    """
    cell_size = check_integer("cell_size", cell_size)
    return _render(state, grasp, cell_size=cell_size, grid=bool(grid))


def rgb(features: jax.Array) -> jax.Array:
    """The colours u8[..., 3] in which `render` shows features u8[..., N]."""
    num_features = features.shape[-1]
    if num_features == 1:
        return jnp.repeat(features, 3, axis=-1)
    if num_features == 2:
        return jnp.pad(features, [*[(0, 0)] * (features.ndim - 1), (0, 1)])
    return features[..., :3]


def render_object(code: int, cell_size: int = 32) -> np.ndarray:
    """An object in its base colour with its sign, for legends. Host side.

    Args:
      code: the object's code, 0 to 7.
      cell_size: s >= 1, pixels per side.

    Returns:
      u8[s, s, 3].

    Raises:
      ValueError: naming the value and what is allowed.
    """
    cell_size = check_integer("cell_size", cell_size)
    if code not in range(NUM_OBJECTS):
        raise ValueError(f"code must be an object code from 0 to {NUM_OBJECTS - 1}, got {code!r}")
    color = np.broadcast_to(BASE_COLORS[code], (cell_size, cell_size, 3)).astype(np.float32)
    sign = _signs(cell_size)[code]
    return np.asarray(_to_pixels(_blend(color, _ink(color), sign * SIGN_OPACITY)))


def episode_frames(state: State, actions: Any, cell_size: int = 20) -> np.ndarray:
    """The pictures of an episode: u8[T + 1, 12 s, 12 s, 3]. Host side.

    Each shows the board before an action, with the hand in that action's grasp
    direction; the last shows where the actions lead, without a hand.

    Args:
      state: one unbatched state, unfinished.
      actions: i32[T, 2], (grasp, move) pairs, each 0 up, 1 down, 2 left, 3 right; or (-1, -1),
        the padding of a `Plan`, which moves nothing. T may be 0.
      cell_size: s >= 1, pixels per cell and side.

    Raises:
      ValueError: naming the argument and what is allowed.
    """
    cell_size = check_integer("cell_size", cell_size)
    actions = np.asarray(actions)
    if not actions.size:
        actions = np.zeros((0, 2), np.int32)
    if actions.shape[1:] != (2,) or actions.dtype.kind not in "iu":
        raise ValueError(
            "actions must be integer[T, 2], (grasp, move) pairs, got "
            f"{actions.dtype}{list(actions.shape)}"
        )
    in_range = ((actions >= 0) & (actions < NUM_DIRECTIONS)).all(axis=1)
    wrong = actions[~in_range & (actions != NO_DIRECTION).any(axis=1)]
    if len(wrong):
        raise ValueError(
            f"actions must be pairs of directions, each 0 to {NUM_DIRECTIONS - 1}, or "
            f"({NO_DIRECTION}, {NO_DIRECTION}), got {tuple(wrong[0].tolist())}"
        )
    return np.asarray(_episode_frames(state, actions.astype(np.int32), cell_size=cell_size))


def save_gif(
    frames: Any, path: str | os.PathLike[str], fps: float = 8, *, hold: float = 1.0
) -> None:
    """Writes an endlessly looping GIF. Host side.

    Args:
      frames: u8[T, height, width, 3], or a sequence of T pictures; T >= 1.
      path: the file to write.
      fps: frames per second, over 0 and at most 50.
      hold: seconds by which the last frame stays longer. Equal frames in a row become one, as
        long as they together. No frame may last longer than 655.35.

    Raises:
      ValueError: naming the value and what is allowed.
    """
    if isinstance(frames, str | os.PathLike):
        raise ValueError(f"save_gif takes (frames, path), in this order; got {frames!r} as frames")
    pictures = np.asarray(frames)
    if pictures.dtype != np.uint8 or pictures.ndim != 4 or pictures.shape[-1] != 3:
        raise ValueError(
            f"frames must be uint8[T, height, width, 3], got {pictures.dtype}{list(pictures.shape)}"
        )
    if not len(pictures):
        raise ValueError("frames must hold at least one picture, got none")
    if not 0 < fps <= MAX_FPS:
        raise ValueError(f"fps must be over 0 and at most {MAX_FPS}, got {fps}")
    if not 0 <= hold < np.inf:
        raise ValueError(f"hold must be a number of seconds >= 0, got {hold}")
    images = _indexed(pictures)
    durations = [round(1000 / fps)] * len(images)
    durations[-1] += round(1000 * hold)
    longest = _longest_shown(images, durations)
    if longest > 1000 * LONGEST_FRAME:
        raise ValueError(
            f"a frame of a GIF lasts at most {LONGEST_FRAME} s, got {longest / 1000} s: 1 / fps "
            "for each of the equal frames in a row, and hold for the last"
        )
    first, *rest = images
    options: dict[str, Any] = {"save_all": True, "append_images": rest, "optimize": True}
    first.save(path, format="GIF", duration=durations, loop=0, **options)


def _longest_shown(images: list[Any], durations: list[int]) -> int:
    """The longest duration of a picture: Pillow joins equal ones in a row."""
    shown = itertools.groupby(
        zip(images, durations, strict=True), key=lambda pair: pair[0].convert("RGB").tobytes()
    )
    return max(sum(duration for _, duration in pairs) for _, pairs in shown)


def _indexed(pictures: np.ndarray) -> list[Any]:
    """Pillow images of at most 256 colours: the exact ones where they are no more."""
    from PIL import Image  # noqa: PLC0415  importing the environment must stay light

    red, green, blue = np.moveaxis(pictures.astype(np.uint32), -1, 0)
    packed = red << 16 | green << 8 | blue
    colors = np.unique(packed)
    if len(colors) > 256:
        # Dithering would speckle plain colours and double the size of the file.
        return [Image.fromarray(each).quantize(dither=Image.Dither.NONE) for each in pictures]
    palette = np.stack([colors >> 16, colors >> 8 & 255, colors & 255], axis=-1)
    images = []
    for indices in np.searchsorted(colors, packed).astype(np.uint8):
        image = Image.fromarray(indices).convert("P")
        image.putpalette(palette.astype(np.uint8).tobytes())
        images.append(image)
    return images


@functools.partial(jax.jit, static_argnames="cell_size")
def _episode_frames(state: State, actions: jax.Array, *, cell_size: int) -> jax.Array:
    actions = jnp.pad(actions, ((0, 1), (0, 0)), constant_values=NO_DIRECTION)
    is_padding = jnp.all(actions == NO_DIRECTION, axis=1)
    # Of padding in a row, which moves nothing, only the first is drawn.
    is_drawn = ~is_padding | jnp.pad(~is_padding[:-1], (1, 0), constant_values=True)

    def body(carry: tuple[State, jax.Array], at: tuple[jax.Array, jax.Array]) -> Any:
        (state, picture), (action, is_drawn) = carry, at
        picture = jax.lax.cond(
            is_drawn, lambda: render(state, cell_size, grasp=action[0]), lambda: picture
        )
        return (step(state, action), picture), picture

    nothing = jnp.zeros((BOARD_SIZE * cell_size, BOARD_SIZE * cell_size, 3), jnp.uint8)
    _, frames = jax.lax.scan(body, (state, nothing), (actions, is_drawn))
    return frames


@functools.partial(jax.jit, static_argnames=("cell_size", "grid"))
def _render(
    state: State, grasp: jax.Array | int | None, *, cell_size: int, grid: bool
) -> jax.Array:
    objects = visible_objects(state)
    image = _enlarge(rgb(observe(state)), cell_size).astype(jnp.float32)
    ink = _ink(image)
    if cell_size >= SMALLEST_SIGN:
        is_tool = _enlarge(objects, cell_size) == TOOL
        sign = jnp.where(is_tool, _tool_bar(state, cell_size), _arrange(_signs(cell_size), objects))
        image = _blend(image, ink, sign * SIGN_OPACITY)
    if grid and cell_size >= SMALLEST_GRID:
        image = _blend(image, ink, _grid_lines(cell_size) * GRID_OPACITY)
    if grasp is not None and cell_size >= SMALLEST_SIGN:
        image = _draw_hand(image, state, jnp.asarray(grasp), cell_size)
    return _to_pixels(image)


def _enlarge(cells: jax.Array, cell_size: int) -> jax.Array:
    """[12 s, 12 s, ...]: every cell of [12, 12, ...] repeated s times down and across."""
    return jnp.repeat(jnp.repeat(cells, cell_size, axis=0), cell_size, axis=1)


def _arrange(tiles: np.ndarray, objects: jax.Array) -> jax.Array:
    """[12 s, 12 s]: of tiles [8, s, s], the one of each cell's object u8[12, 12]."""
    size = BOARD_SIZE * tiles.shape[-1]
    return jnp.asarray(tiles)[objects].transpose(0, 2, 1, 3).reshape(size, size)


def _ink(color: Any) -> Any:
    """f32[h, w, 1]: black or white, whichever stands out from f32[h, w, 3]."""
    return (color @ LUMA.astype(np.float32) < 128)[..., None] * np.float32(255)


def _blend(image: Any, ink: Any, opacity: Any) -> Any:
    """f32[h, w, 3]: `ink` over `image`, with opacity f32[h, w] from 0 to 1."""
    return image + (ink - image) * opacity[..., None]


def _to_pixels(image: Any) -> jax.Array:
    return jnp.round(image).astype(jnp.uint8)


# A sign is a signed distance field over pixel centres, in units of a cell: negative
# inside the shape. A ramp of one pixel at its edge keeps it smooth at every size.


@functools.cache
def _signs(cell_size: int) -> np.ndarray:
    """f32[8, s, s]: how far each object's sign covers each pixel of its cell, 0 to 1."""
    y, x = _offsets((0.5, 0.5), 1, cell_size)
    distance = np.full((NUM_OBJECTS, cell_size, cell_size), np.inf, np.float32)
    if cell_size >= SMALLEST_SIGN:
        distance[TRAP] = _cross(y, x)
        distance[EXIT] = abs(np.hypot(y, x) - 0.24) - 0.07
        distance[TUBE1] = _hatching(x + y)
        distance[TUBE2] = _hatching(x - y)
        distance[FOOD] = _apple(y, x)
        distance[TOOL] = np.hypot(np.maximum(abs(y) - TOOL_BAR_OVERHANG, 0), x) - TOOL_BAR_RADIUS
        distance[AGENT] = _face(y, x)
    return _coverage(distance, cell_size)


def _cross(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    to_diagonals = np.minimum(abs(x - y), abs(x + y)) / np.sqrt(2)
    return np.maximum(to_diagonals - 0.07, np.maximum(abs(x), abs(y)) - 0.29)


def _hatching(across: np.ndarray) -> np.ndarray:
    """Two diagonals per cell, which meet those of the neighbouring cells."""
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
    """f32[12 s, 12 s]: a bar with round ends along the tool; a single cell is vertical."""
    along = jnp.where(state.tool_extent[1] > 1, np.array([0, 1]), np.array([1, 0]))
    half = (state.tool_extent - 1) / 2 + TOOL_BAR_OVERHANG * along
    y, x = _offsets(state.tool + state.tool_extent / 2, BOARD_SIZE, cell_size)
    outside = [jnp.maximum(abs(y) - half[0], 0), jnp.maximum(abs(x) - half[1], 0)]
    return _coverage(jnp.hypot(*outside) - TOOL_BAR_RADIUS, cell_size)


def _draw_hand(image: jax.Array, state: State, grasp: jax.Array, cell_size: int) -> jax.Array:
    """Draws a white hand with a black outline on the agent's border in the grasp direction."""
    y, x = _offsets(state.agent + 0.5 + 0.5 * unit_vector(grasp), BOARD_SIZE, cell_size)
    disc = jnp.hypot(y, x) - HAND_RADIUS
    hand = jnp.where(holds_tool(state, grasp), disc, jnp.abs(disc + 0.07) - 0.07)
    is_shown = (grasp >= 0) & (grasp < NUM_DIRECTIONS)
    outline = _coverage(hand - 0.05, cell_size) * is_shown
    image = _blend(image, 0.0, outline)
    return _blend(image, 255.0, _coverage(hand, cell_size) * is_shown)


def _offsets(center: Any, num_cells: int, cell_size: int) -> tuple[Any, Any]:
    """f32[n s, 1] and f32[1, n s]: how far every pixel lies below and right of `center`.

    Both `center`, (y, x), and the result are in units of a cell.
    """
    along = (np.arange(num_cells * cell_size, dtype=np.float32) + 0.5) / cell_size
    return (along - center[0])[:, None], (along - center[1])[None, :]


def _coverage(distance: Any, cell_size: int) -> Any:
    """The part of each pixel that lies inside the shape, 0 to 1, as f32."""
    return (0.5 - distance * cell_size).clip(0, 1)


def _grid_lines(cell_size: int) -> np.ndarray:
    """f32[12 s, 12 s]: 1 on the lines around the cells, 0 elsewhere."""
    width = max(1, cell_size // 32)
    pixels = np.arange(BOARD_SIZE * cell_size)
    on_line = (pixels % cell_size < width) | (pixels >= len(pixels) - width)
    return (on_line[:, None] | on_line).astype(np.float32)
