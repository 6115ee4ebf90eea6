"""The tasks of a profile, in parts. Sources: graded.md and controls.md of `trap_tube_jax`."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

import trap_tube_jax as tt
from trap_tube_jax.controls import CONTROLS, with_every_start
from trap_tube_jax.objects import EXIT, OBJECT_NAMES, TRAP
from trap_tube_jax.scoring.tasks import fixed_tasks
from trap_tube_jax.state import concatenate_trees
from trap_tube_jax.transfers import SYMBOLIC_OBJECTS, Transfer, swap_with_tool

# All parts draw with the keys of this name. Hence "perceptual" and "both" have the same layouts,
# and the colours of a task move along one path as the strength rises.
KEYS = "profile"
STRENGTHS = (0.0, 0.05, 0.1, 0.25, 0.5, 0.75, 1.0)
SECOND_LAYOUTS = {"no-trap": "two exits", "two-traps": "other exit", "food-outside": "near"}
BIN = 5  # steps, the width of the groups by plan length
FIRST_PUSHES = {1: "to the exit", -1: "away from it", 0: "no choice"}
FIRST_GRASPS = {1: "the tool", -1: "another object", 0: "no grasp"}


class Part(NamedTuple):
    """Tasks of a profile, and the groups in which their episodes are counted.

    Attributes:
      tasks: B states at time 0, as NumPy arrays.
      levels: names of B groups, or a function that names the groups of B episodes, with columns as
        in `measure.episodes`, in the order of its categories.
    """

    tasks: tt.State
    levels: Sequence[str] | Callable[[Any], pd.Categorical]


class Sampling(NamedTuple):
    """The settings by which parts draw their tasks; see `measure.profile`."""

    strengths: Sequence[float]
    num_tasks: int
    num_features: int


def plan_lengths(episodes: Any) -> pd.Categorical:
    """Groups B episodes by the length of the task's shortest plan."""
    starts = (episodes["plan"] // BIN * BIN).astype(int)
    names = {start: f"{start}-{start + BIN - 1}" for start in sorted(set(starts))}
    return pd.Categorical(starts.map(names), list(names.values()))


def first_pushes(episodes: Any) -> pd.Categorical:
    """Groups B episodes by the choice of their first push."""
    return pd.Categorical(episodes["choice"].map(FIRST_PUSHES), list(FIRST_PUSHES.values()))


def first_grasps(episodes: Any) -> pd.Categorical:
    """Groups B episodes by the object of their first grasp."""
    return pd.Categorical(episodes["grasp"].map(FIRST_GRASPS), list(FIRST_GRASPS.values()))


def layout_kinds(tasks: tt.State) -> list[str]:
    """Names the arrangement of food and tool in B tasks of {P}.

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


def _kind(sampling: Sampling) -> Part:
    tasks = _draw((tt.perceptual,), sampling)
    return Part(tasks, layout_kinds(tasks))


def _grouped(
    transfers: Sequence[Transfer], levels: Callable[[Any], pd.Categorical], sampling: Sampling
) -> Part:
    return Part(_draw(transfers, sampling), levels)


def control_layouts(num_features: int = 3) -> dict[str, tt.State]:
    """Returns the base task and the layouts of all controls, by name and in base colours."""
    base = tt.base_state(num_features)
    made = {"base": base}
    for layouts in CONTROLS:
        short = layouts.__name__.replace("_", "-")
        names = (short, f"{short}, {SECOND_LAYOUTS.get(short)}")
        for name, state in zip(names, layouts(), strict=False):
            made[name] = state.replace(palette=base.palette)
    return made


def _control(sampling: Sampling) -> Part:
    layouts = control_layouts(sampling.num_features)
    return _join({name: with_every_start(state) for name, state in layouts.items()})


PARTS: dict[str, Callable[[Sampling], Part]] = {
    "structural": partial(_graded, (tt.graded_structural,)),
    "perceptual": partial(_graded, (tt.graded_perceptual,)),
    "both": partial(_graded, (tt.graded_perceptual, tt.graded_structural)),
    "symbolic": _symbolic,
    "kind": _kind,
    "plan-length": partial(_grouped, (tt.perceptual,), plan_lengths),
    "first-push-p": partial(_grouped, (tt.perceptual,), first_pushes),
    "first-push-pst": partial(_grouped, (tt.perceptual, tt.structural), first_pushes),
    "first-grasp-psy": partial(_grouped, (tt.perceptual, tt.symbolic), first_grasps),
    "first-grasp-pstsy": partial(
        _grouped, (tt.perceptual, tt.structural, tt.symbolic), first_grasps
    ),
    "control": _control,
}
FIRST_TRIES = {
    "first-push-p": FIRST_PUSHES,
    "first-push-pst": FIRST_PUSHES,
    "first-grasp-psy": FIRST_GRASPS,
    "first-grasp-pstsy": FIRST_GRASPS,
}


def _draw(transfers: Sequence[Transfer], sampling: Sampling) -> tt.State:
    env = tt.Environment(tuple(transfers), base=tt.base_state(sampling.num_features))
    return jax.device_get(fixed_tasks(env, KEYS, sampling.num_tasks))


def _join(groups: dict[str, tt.State]) -> Part:
    return Part(
        concatenate_trees(groups.values()),
        [name for name, states in groups.items() for _ in states.time],
    )
