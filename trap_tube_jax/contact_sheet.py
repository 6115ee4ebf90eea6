"""Contact sheets: task sets with some of their tasks each, and a legend of the objects."""

from collections.abc import Sequence

import jax
import numpy as np

from trap_tube_jax.checks import check_integer, check_seed
from trap_tube_jax.imports import needs_extra
from trap_tube_jax.objects import BOARD_SIZE, NUM_OBJECTS, OBJECT_NAMES
from trap_tube_jax.observation import visible_objects
from trap_tube_jax.registry import PAPER_TASK_SETS, TaskSet, make, task_set
from trap_tube_jax.rendering import render, render_object
from trap_tube_jax.transfers import Transfer, perceptual, structural, symbolic

with needs_extra("pictures"):
    from PIL import Image, ImageDraw, ImageFont

CHANGES: dict[Transfer, str] = {
    perceptual: "layout",
    structural: "colours",
    symbolic: "what is the tool",
}
DRAWS = 64  # tasks among which the distinct ones of a panel are found
BACKGROUND, TEXT, FAINT_TEXT = "#ffffff", "#1f2328", "#656d76"


def contact_sheet(
    ids: Sequence[str] = tuple(entry.id for entry in PAPER_TASK_SETS),
    *,
    tasks: int = 4,
    cell_size: int = 16,
    seed: int = 0,
) -> Image.Image:
    """Draws task sets with some of their tasks each, and a legend of the objects.

    Args:
      ids: the task sets, at least one; the paper's eight if absent.
      tasks: most tasks per set, at least 2: the first different ones of 64 draws. The base has
        one task, and the legend fills its row.
      cell_size: pixels per cell and side, at least 8.
      seed: seed of the tasks, 0 to 2**32 - 1.

    Raises:
      ValueError: an argument is invalid; the message says what is allowed.
    """
    tasks = check_integer("tasks", tasks, 2)
    cell_size = check_integer("cell_size", cell_size, 8)
    seed = check_seed(seed)
    if isinstance(ids, str) or not ids:
        raise ValueError(f"ids must name at least one task set, as in ('base', 'p'), got {ids!r}")
    panels = [_panel(task_set(name), tasks, cell_size, seed) for name in ids]
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    margin = 2 * cell_size
    width, height = (length + margin for length in panels[0].size)
    sheet = Image.new("RGB", (columns * width + margin, rows * height + margin), BACKGROUND)
    for index, panel in enumerate(panels):
        row, column = divmod(index, columns)
        sheet.paste(panel, (margin + column * width, margin + row * height))
    return sheet


def _panel(entry: TaskSet, tasks: int, cell_size: int, seed: int) -> Image.Image:
    """Draws a title and a row of tasks, or of the only task and the legend."""
    tile, gap, header = BOARD_SIZE * cell_size, cell_size // 2, 3 * cell_size
    width = tasks * (tile + gap) - gap
    panel = Image.new("RGB", (width, header + tile), BACKGROUND)
    draw = ImageDraw.Draw(panel)
    changes = ", ".join(CHANGES.get(transfer, "own") for transfer in entry.transfers)
    subtitle = f"changes: {changes}" if changes else "the task to learn from"
    draw.text((0, 0), entry.id, TEXT, _font(cell_size * 1.25))
    draw.text((0, cell_size * 1.55), f"{entry.label}   {subtitle}", FAINT_TEXT, _font(cell_size))
    pictures = _distinct_tasks(entry, tasks, cell_size, seed)
    for index, picture in enumerate(pictures):
        panel.paste(Image.fromarray(picture), (index * (tile + gap), header))
    if len(pictures) == 1:
        _draw_legend(draw, panel, (tile + 2 * gap, header), (width - tile - 2 * gap, tile))
    return panel


def _distinct_tasks(entry: TaskSet, tasks: int, cell_size: int, seed: int) -> np.ndarray:
    """Draws the first K <= `tasks` different tasks among `DRAWS`, u8[K, 12 s, 12 s, 3]."""
    keys = jax.random.split(jax.random.key(seed), DRAWS)
    states, _ = jax.jit(jax.vmap(make(entry.id).reset))(keys)
    # Observations would not do: the symbolic swap leaves all colours in place.
    looks = [
        jax.vmap(visible_objects)(states).reshape(DRAWS, -1),
        states.palette.reshape(DRAWS, -1),
    ]
    _, first = np.unique(np.concatenate(looks, axis=1), axis=0, return_index=True)
    first = np.sort(first)[:tasks]
    chosen = jax.tree.map(lambda x: x[first], states)
    return np.asarray(jax.vmap(lambda state: render(state, cell_size))(chosen))


def _draw_legend(
    draw: ImageDraw.ImageDraw, panel: Image.Image, corner: tuple[int, int], size: tuple[int, int]
) -> None:
    """Draws the eight objects in two columns of four into the box at `corner` of `size`."""
    column_width, row_height = size[0] // 2, size[1] // 4
    swatch = round(0.7 * row_height)
    for code in range(NUM_OBJECTS):
        column, row = divmod(code, 4)
        x = corner[0] + column * column_width
        y = corner[1] + row * row_height + (row_height - swatch) // 2
        panel.paste(Image.fromarray(render_object(code, swatch)), (x, y))
        middle = (x + 1.3 * swatch, y + swatch / 2)
        draw.text(middle, OBJECT_NAMES[code], TEXT, _font(swatch / 2), anchor="lm")


def _font(size: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
