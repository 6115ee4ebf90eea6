"""Controls of comparative psychology: layouts that tell understanding from rules of thumb.

Each function lists the layouts of one control. Most layouts differ from the base task in one
respect, so that they can be compared in pairs. The rules of the environment are unchanged.

Source: controls.md, with the studies in full.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from trap_tube_jax.geometry import bar_cells
from trap_tube_jax.objects import BOARD_SIZE, GROUND, OBJECT_CHARS
from trap_tube_jax.prng import threefry_key
from trap_tube_jax.state import State, check_state

Cell = tuple[int, int]
FIRST_ROW = 4  # of the base task's tube


def trap_turned() -> tuple[State, ...]:
    """Builds a tube whose trap is in the wall, out of the food's way, and whose ends are exits.

    The short way goes past the trap. An agent that avoids the trap takes the long way.
    Source: Visalberghi and Limongelli (1994), Reaux and Povinelli (2000): the inverted tube.
    """
    return (_layout("....1xx1....", "....eF.e....", "....e..e....", "....2222...."),)


def trap_exchanged() -> tuple[State, ...]:
    """Exchanges trap and exit: the food must go the other way.

    Source: Limongelli, Boysen and Visalberghi (1995): the food in the middle of the tube, the trap
    left of it or right.
    """
    return (_layout("....1111....", "....eF.x....", "....e..x....", "....2222...."),)


def no_trap() -> tuple[State, ...]:
    """Removes the trap: its end of the tube is closed, or is a second exit.

    Source: Visalberghi and Trinca (1989): the plain tube.
    """
    return (
        _layout("....1111....", "....1F.e....", "....1..e....", "....2222...."),
        _layout("....1111....", "....eF.e....", "....e..e....", "....2222...."),
    )


def two_traps() -> tuple[State, ...]:
    """Adds a trap in the wall on the way to the exit. The food can pass this one only.

    The exit is on the base task's side, or on the other one.
    Source: Seed et al. (2006): tubes with two traps, of which one does nothing.
    """
    return (
        _layout("....1xx1....", "....xF.e....", "....x..e....", "....2222...."),
        _layout("....1xx1....", "....eF.x....", "....e..x....", "....2222...."),
    )


def far_exit() -> tuple[State, ...]:
    """Lengthens the tube by three cells on the side of the exit.

    Source: after Limongelli, Boysen and Visalberghi (1995), who moved the trap off the middle, so
    that the distance to the ends no longer tells the side of the trap.
    """
    return (_layout("....1111111.", "....xF....e.", "....x.....e.", "....2222222."),)


def short_tool() -> tuple[State, ...]:
    """Shortens the tool to two cells: it reaches the food from the nearer wall only.

    Source: after Visalberghi and Trinca (1989): sticks that are of use only in a certain way.
    """
    return (_layout(*_BASE_TUBE, tool=(5, 1), extent=(2, 1)),)


def too_short_tool() -> tuple[State, ...]:
    """Shortens the tool to one cell: it reaches the food from nowhere. No plan solves this.

    Source: Mulcahy, Call and Dunbar (2005): tools too short to reach the food.
    """
    return (_layout(*_BASE_TUBE, tool=(5, 1), extent=(1, 1)),)


def tool_in_tube() -> tuple[State, ...]:
    """Puts the tool into the tube, on the wrong side of the food; it must come out first.

    Source: after Seed et al. (2006), where the stick is in the tube before the trial.
    """
    return (_layout(*_BASE_TUBE, tool=(5, 6)),)


def tool_at_food() -> tuple[State, ...]:
    """Puts the tool next to the food, on the right side of it.

    Source: Bates, Carlson-Luden and Bretherton (1980): tool and goal in contact.
    """
    return (_layout(*_BASE_TUBE, tool=(4, 4)),)


def food_outside() -> tuple[State, ...]:
    """Puts the food outside the tube, beyond it or near the agent: no tool is needed.

    Source: after Köhler (1925): a tool is fetched because the goal is out of reach.
    """
    empty = ("....1111....", "....x..e....", "....x..e....", "....2222....")
    return (_layout(*empty, food=(5, 10)), _layout(*empty, food=(5, 2)))


def with_every_start(layout: State) -> State:
    """Returns a layout once for every cell that the agent can reach by walking, B states.

    The walk leaves the tool where it is. Cells are in reading order. So success on a control is a
    share of many episodes, not the verdict of one.
    """
    from scipy import ndimage  # noqa: PLC0415  importing the environment must stay light

    layout = jax.device_get(layout)
    is_tool = bar_cells(layout.tool, layout.tool_extent)
    is_free = (layout.board == GROUND) & ~np.asarray(is_tool)
    is_free[tuple(layout.food)] = False
    is_start = np.zeros_like(is_free)
    is_start[tuple(layout.agent)] = True
    starts = np.argwhere(ndimage.binary_propagation(is_start, mask=is_free))
    batch = jax.tree.map(lambda x: np.broadcast_to(x, (len(starts), *np.shape(x))), layout)
    return batch.replace(agent=starts.astype(np.int32))


@dataclasses.dataclass(frozen=True)
class LayoutDraw:
    """The transfer that draws one of the states listed by `layouts`, each with equal chance.

    It keeps the state's palette, time and flags, and composes with the others.
    """

    layouts: Callable[[], tuple[State, ...]]

    def __call__(self, key: jax.Array, state: State) -> State:
        """Draws a layout."""
        check_state(state)
        choices = self.layouts()
        index = jax.random.randint(threefry_key(key), (), 0, len(choices), jnp.int32)
        fields = ("board", "agent", "tool", "tool_extent", "food")
        tables = {name: [np.asarray(getattr(each, name)) for each in choices] for name in fields}
        return state.replace(
            **{name: jnp.asarray(np.stack(table))[index] for name, table in tables.items()}
        )

    @property
    def __name__(self) -> str:
        return self.layouts.__name__.replace("_", " ")


CONTROLS = (
    trap_turned,
    trap_exchanged,
    no_trap,
    two_traps,
    far_exit,
    short_tool,
    too_short_tool,
    tool_in_tube,
    tool_at_food,
    food_outside,
)

_BASE_TUBE = ("....1111....", "....xF.e....", "....x..e....", "....2222....")


def _layout(
    *tube: str, tool: Cell = (4, 1), extent: Cell = (4, 1), food: Cell | None = None
) -> State:
    """Builds the base task with other rows 4 to 7, another tool, or food that is not drawn."""
    empty = OBJECT_CHARS[GROUND] * BOARD_SIZE
    below = BOARD_SIZE - FIRST_ROW - len(tube)
    rows = [*[empty] * FIRST_ROW, *tube, *[empty] * below]
    return State.from_ascii(rows, agent=(9, 1), tool=tool, tool_extent=extent, food=food)
