"""The vocabulary of the trap-tube gridworld: objects, colours, directions.

Glossary
    board: the static objects (ground, trap, exit, tubes), one code per cell.
    cell: a (row, column) pair; row 0 is the top, column 0 the left.
    extent: the tool's size as (rows, columns).
    palette: one row of features (RGB by default) per object code.
    role: what an object code does, whatever it looks like.

Source: paper, section "Environments"; environment.md, "Board and objects" and "Actions".
"""

from typing import Final

import numpy as np

from trap_tube_jax.checks import check_integer

BOARD_SIZE: Final = 12
MAX_TOOL_LENGTH: Final = 4
MAX_STEPS: Final = 50
MAX_FEATURES: Final = 1024

# Codes are in drawing order: a later object hides an earlier one.
GROUND, TRAP, EXIT, TUBE1, TUBE2, FOOD, TOOL, AGENT = range(8)
OBJECT_NAMES: Final = ("ground", "trap", "exit", "tube1", "tube2", "food", "tool", "agent")
OBJECT_CHARS: Final = ".xe12FTA"
NUM_OBJECTS: Final = len(OBJECT_NAMES)
STATIC_OBJECTS: Final = (GROUND, TRAP, EXIT, TUBE1, TUBE2)

BASE_COLORS: Final = np.array(
    [
        [72, 65, 17],  # ground
        [208, 113, 57],  # trap
        [208, 189, 57],  # exit
        [57, 152, 208],  # tube1
        [57, 152, 208],  # tube2
        [208, 57, 77],  # food
        [152, 208, 57],  # tool
        [113, 57, 208],  # agent
    ],
    np.uint8,
)
LUMA: Final = np.array([0.299, 0.587, 0.114])  # ITU-R BT.601

UP, DOWN, LEFT, RIGHT = range(4)
DIRECTION_NAMES: Final = ("up", "down", "left", "right")
DIRECTIONS: Final = np.array([[-1, 0], [1, 0], [0, -1], [0, 1]], np.int32)
NUM_DIRECTIONS: Final = len(DIRECTION_NAMES)
NO_DIRECTION: Final = -1  # any number outside 0 to 3 is no direction
NUM_ACTIONS: Final = NUM_DIRECTIONS**2


def base_palette(num_features: int = 3) -> np.ndarray:
    """Returns the features of every object before any transfer.

    Three features are the RGB colours of environment.md, "Board and objects". Two are the
    red and green channels. More than three repeat red, green and blue. One feature is the
    colour's luma (ITU-R BT.601), rounded. For every N all objects differ pairwise,
    except the two tubes, which always look alike.

    Args:
      num_features: N, the number of feature channels, 1 to 1024.

    Returns:
      u8[8, N], one row per object code.

    Raises:
      ValueError: `num_features` is not an integer from 1 to 1024.

    Example:
      >>> tt.base_palette().shape, tt.base_palette()[5].tolist()  # the food's colour
      ((8, 3), [208, 57, 77])
    """
    check_integer("num_features", num_features, maximum=MAX_FEATURES)
    if num_features == 1:
        return np.rint(BASE_COLORS @ LUMA).astype(np.uint8)[:, None]
    return BASE_COLORS[:, np.arange(num_features) % 3]
