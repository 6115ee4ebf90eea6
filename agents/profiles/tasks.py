"""The tasks of a profile, in parts. Sources: graded.md and controls.md of `trap_tube_jax`."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import trap_tube_jax as tt
from trap_tube_jax.controls import CONTROLS
from trap_tube_jax.objects import EXIT, OBJECT_NAMES, TRAP
from trap_tube_jax.scoring.tasks import fixed_tasks
from trap_tube_jax.state import State
from trap_tube_jax.transfers import SYMBOLIC_OBJECTS, Transfer, swap_with_tool

# All parts draw with the keys of this name. Hence "perceptual" and "both" have the same layouts,
# and the colours of a task move along one path as the strength rises.
KEYS = "profile"
STRENGTHS = (0.0, 0.05, 0.1, 0.25, 0.5, 0.75, 1.0)
SECOND_LAYOUTS = {"no-trap": "two exits", "two-traps": "other exit", "food-outside": "near"}


class Part(NamedTuple):
    """Tasks of a profile, and the group that each is counted in.

    Attributes:
      tasks: B states at time 0, as NumPy arrays.
      levels: B names of groups; None to group by the length of the shortest plan.
    """

    tasks: State
    levels: Sequence[str] | None


class Sampling(NamedTuple):
    """The settings by which parts draw their tasks; see `measure.profile`."""

    strengths: Sequence[float]
    num_tasks: int
    num_features: int


def layout_kinds(tasks: State) -> list[str]:
    """Names how food and tool are placed in each of B tasks of {P}.

    The food leaves the tube "away" from the agent, "towards" the agent or "sideways"; the tool
    points "along" this direction or "across" it.
    """
    parts = map(np.asarray, (tasks.board, tasks.agent, tasks.tool_extent))
    found = []
    for cells, agent, extent in zip(*parts, strict=True):
        trap, end = (np.argwhere(cells == code).mean(axis=0) for code in (TRAP, EXIT))
        way = np.sign(end - trap)
        offset = agent - (trap + end) / 2
        ahead = offset @ way
        aside = np.abs(offset).sum() - abs(ahead)
        direction = "sideways" if aside > abs(ahead) else "towards" if ahead > 0 else "away"
        tool = "along" if extent @ np.abs(way) > 1 else "across"
        found.append(f"{direction}, {tool}")
    return found


def _graded(grades: Sequence[Callable[[float], Transfer]], sampling: Sampling) -> Part:
    drawn = {}
    for strength in sampling.strengths:
        transfers = [grade(strength) for grade in grades]
        drawn[f"{strength:g}"] = _draw(transfers if strength > 0 else (), sampling)
    return _join(drawn)


def _symbolic(sampling: Sampling) -> Part:
    """Swaps the tool with each object in the tasks of {P, St}; "tool" is no swap."""
    tasks = _draw((tt.perceptual, tt.structural), sampling)
    swap = jax.jit(jax.vmap(swap_with_tool, in_axes=(0, None)))
    return _join({OBJECT_NAMES[code]: swap(tasks, jnp.asarray(code)) for code in SYMBOLIC_OBJECTS})


def _perceptual(levels: Callable[[State], Sequence[str] | None], sampling: Sampling) -> Part:
    tasks = _draw((tt.perceptual,), sampling)
    return Part(tasks, levels(tasks))


def _control(sampling: Sampling) -> Part:
    palette = jnp.asarray(tt.base_palette(sampling.num_features))
    made = {"base": _draw((), sampling)}
    for layouts in CONTROLS:
        short = layouts.__name__.replace("_", "-")
        names = (short, f"{short}, {SECOND_LAYOUTS.get(short)}")
        for name, state in zip(names, layouts(), strict=False):
            made[name] = jax.tree.map(lambda x: x[None], state.replace(palette=palette))
    return _join(made)


PARTS: dict[str, Callable[[Sampling], Part]] = {
    "structural": partial(_graded, (tt.graded_structural,)),
    "perceptual": partial(_graded, (tt.graded_perceptual,)),
    "both": partial(_graded, (tt.graded_perceptual, tt.graded_structural)),
    "symbolic": _symbolic,
    "kind": partial(_perceptual, layout_kinds),
    "plan-length": partial(_perceptual, lambda tasks: None),
    "control": _control,
}


def _draw(transfers: Sequence[Transfer], sampling: Sampling) -> State:
    env = tt.Environment(tuple(transfers), base=tt.base_state(sampling.num_features))
    return jax.device_get(fixed_tasks(env, KEYS, sampling.num_tasks))


def _join(groups: dict[str, State]) -> Part:
    tasks = jax.tree.map(lambda *parts: np.concatenate(parts), *groups.values())
    return Part(tasks, [name for name, states in groups.items() for _ in states.time])
