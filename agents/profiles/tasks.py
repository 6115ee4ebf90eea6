"""The tasks of a profile: points at rising distance from the base task.

Source: graded.md and controls.md, beside the environment.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import trap_tube_jax as tt
from trap_tube_jax.controls import CONTROLS, trap_and_exit_exchanged
from trap_tube_jax.environment import Environment
from trap_tube_jax.objects import EXIT, OBJECT_NAMES, TOOL, TRAP
from trap_tube_jax.scoring.tasks import fixed_tasks
from trap_tube_jax.state import State
from trap_tube_jax.transfers import SYMBOLIC_OBJECTS, Transfer, swap_with_tool

# One name for all points: they draw with the same keys. So the layouts of `layout` and `both` are
# the same, and the colours of a task move along one path as the strength rises.
KEYS = "profile"
BASE = "base"
STRENGTHS = (0.05, 0.1, 0.25, 0.5, 0.75, 1.0)
GRADED = ("colours", "layout", "both")
ALL_LAYOUTS = "layout 1"  # the point of {P}
WAYS, LIES = ("away", "sideways", "towards"), ("across", "along")
KINDS = tuple(f"{way}, {lies}" for way in WAYS for lies in LIES)
PARTS = (*GRADED, "swaps", "controls", "pairs")
NEED_WHOLE = {"colours": (), "layout": ("pairs",), "both": ("pairs", "swaps")}  # strength 1
SWAPS = {OBJECT_NAMES[code]: int(code) for code in SYMBOLIC_OBJECTS if code != TOOL}
# What the second layout of a control is called.
SECOND = {"no-trap": "two exits", "two-traps": "other exit", "food-outside": "near"}


class Point(NamedTuple):
    """Tasks that are alike in their distance from the base task.

    Attributes:
      axis: what is changed: `base`, nothing; one of `GRADED`; `swap`, the tool's looks in the
        base task; `swap of both`, in tasks of {P, St}; `control`; `twin`, trap and exit exchanged.
      value: how far, or with what.
      tasks: B states at time 0.
    """

    axis: str
    value: float | str
    tasks: State


def kinds(tasks: State) -> list[str]:
    """Which way the food leaves the tube in each of B tasks of {P}, and how the tool lies.

    Returns:
      Of each task first `away` from where the agent starts, `towards` it, or `sideways`; then
      whether the tool lies `along` that way or `across` it.
    """
    parts = map(np.asarray, (tasks.board, tasks.agent, tasks.tool_extent))
    found = []
    for cells, agent, extent in zip(*parts, strict=True):
        trap, leaves = (np.argwhere(cells == code).mean(axis=0) for code in (TRAP, EXIT))
        way = np.sign(leaves - trap)
        offset = agent - (trap + leaves) / 2
        ahead = offset @ way
        beside = np.abs(offset).sum() - abs(ahead)
        where = "sideways" if beside > abs(ahead) else "towards" if ahead > 0 else "away"
        lies = "along" if extent @ np.abs(way) > 1 else "across"
        found.append(f"{where}, {lies}")
    return found


# The names of two points whose tasks differ in the trap alone, one by one.
PAIRS = {
    "base": (BASE, "control trap-exchanged"),
    "two traps": ("control two-traps", "control two-traps, other exit"),
    "{P}": (ALL_LAYOUTS, f"{ALL_LAYOUTS}, exchanged"),
    "{P, St}": ("both 1", "both 1, exchanged"),
}


def points(
    parts: Sequence[str], strengths: Sequence[float], num_tasks: int, num_features: int
) -> dict[str, Point]:
    """All points that the parts of a profile need, by name.

    Args:
      parts: some of `PARTS`.
      strengths: above 0, to 1, which is added if it is missing.
      num_tasks: tasks of every point that has more than one.
      num_features: N, feature channels.

    Raises:
      ValueError: a part is unknown, a strength or the number of tasks is not allowed.
    """
    unknown = [part for part in parts if part not in PARTS]
    if unknown or not parts:
        raise ValueError(f"unknown parts {unknown}; allowed: one or more of {', '.join(PARTS)}")
    wanted = set(parts)
    made = {BASE: Point(BASE, 0.0, _draw((), 1, num_features))}
    for axis in GRADED:
        whole = {1.0} if wanted & {axis, *NEED_WHOLE[axis]} else set()
        for strength in sorted({*strengths, *whole} if axis in wanted else whole):
            tasks = _draw(_graded(axis, strength), num_tasks, num_features)
            made[f"{axis} {strength:g}"] = Point(axis, float(strength), tasks)
    if "swaps" in wanted:
        made |= _swaps(num_tasks, num_features)
    if wanted & {"controls", "pairs"}:
        made |= _controls(num_features)
    if "pairs" in wanted:
        for name in (ALL_LAYOUTS, "both 1"):
            twins = jax.vmap(trap_and_exit_exchanged)(made[name].tasks)
            made[f"{name}, exchanged"] = Point("twin", name, twins)
    return made


def _graded(axis: str, strength: float) -> tuple[Transfer, ...]:
    if not strength > 0:
        raise ValueError(f"strengths must be above 0, to 1, got {strength}; 0 is the base task")
    layout, colours = tt.graded_perceptual(strength), tt.graded_structural(strength)
    return {"colours": (colours,), "layout": (layout,), "both": (layout, colours)}[axis]


def _swaps(num_tasks: int, num_features: int) -> dict[str, Point]:
    made = {}
    for name, code in SWAPS.items():

        def swap(key: jax.Array, state: State, code: int = code) -> State:
            del key
            return swap_with_tool(state, jnp.asarray(code))

        whole = (tt.perceptual, tt.structural, swap)
        made[f"swap {name}"] = Point("swap", name, _draw((swap,), 1, num_features))
        tasks = _draw(whole, num_tasks, num_features)
        made[f"both 1, swap {name}"] = Point("swap of both", name, tasks)
    return made


def _controls(num_features: int) -> dict[str, Point]:
    """The layouts of all controls, in base colours, one a point."""
    made = {}
    for layouts in CONTROLS:
        short = layouts.__name__.replace("_", "-")
        for index, state in enumerate(layouts()):
            name = f"{short}, {SECOND[short]}" if index else short
            seen = state.replace(palette=jnp.asarray(tt.base_palette(num_features)))
            made[f"control {name}"] = Point("control", name, jax.tree.map(lambda x: x[None], seen))
    return made


def _draw(transfers: Sequence[Transfer], num_tasks: int, num_features: int) -> State:
    env = Environment(tuple(transfers), base=tt.base_state(num_features))
    return fixed_tasks(env, KEYS, num_tasks)
