"""Task sets by name: the paper's eight, the controls, and others that users register.

Source: paper, section "Experimental Setup"; environment.md, "Task sets"; controls.md.
"""

import collections
import dataclasses
from collections.abc import Callable, Iterable, Sequence

from trap_tube_jax.checks import check_registered_name, did_you_mean
from trap_tube_jax.controls import CONTROLS, LayoutDraw
from trap_tube_jax.environment import Environment
from trap_tube_jax.objects import MAX_STEPS
from trap_tube_jax.state import State, base_state
from trap_tube_jax.transfers import Mixture, Transfer, compose, perceptual, structural, symbolic


@dataclasses.dataclass(frozen=True)
class TaskSet:
    """A named distribution over tasks.

    Attributes:
      id: name that `make` takes.
      short: name in tables and file names.
      label: name in text: the paper's notation for the paper's sets and mixtures of them, such as
        "{P, St}"; the short name for others.
      transfers: the transfers, in the order in which they apply.
      base: the state that the transfers start from; None is the base task.
      max_steps: steps after which an unsolved episode is truncated.

    Example:
      >>> entry = tt.task_set("pst")
      >>> entry.id, entry.label, entry.max_steps
      ('PerceptualStructuralTrapTube-v0', '{P, St}', 50)
    """

    id: str
    short: str
    label: str
    transfers: tuple[Transfer, ...]
    base: State | None = dataclasses.field(default=None, repr=False)
    max_steps: int = MAX_STEPS

    @property
    def names(self) -> tuple[str, str, str]:
        """The names that `make` takes; two registered sets share none."""
        return self.id, self.short, self.label


PAPER_TASK_SETS = (
    TaskSet("TrapTube-v0", "base", "base", ()),
    TaskSet("PerceptualTrapTube-v0", "p", "{P}", (perceptual,)),
    TaskSet("StructuralTrapTube-v0", "st", "{St}", (structural,)),
    TaskSet("SymbolicTrapTube-v0", "sy", "{Sy}", (symbolic,)),
    TaskSet("PerceptualStructuralTrapTube-v0", "pst", "{P, St}", (perceptual, structural)),
    TaskSet("PerceptualSymbolicTrapTube-v0", "psy", "{P, Sy}", (perceptual, symbolic)),
    TaskSet("StructuralSymbolicTrapTube-v0", "stsy", "{St, Sy}", (structural, symbolic)),
    TaskSet(
        "PerceptualStructuralSymbolicTrapTube-v0",
        "pstsy",
        "{P, St, Sy}",
        (perceptual, structural, symbolic),
    ),
)


def _control(layouts: Callable[[], tuple[State, ...]]) -> TaskSet:
    """Names the set of a control: `trap_turned` is TrapTurnedControl-v0, in short trap-turned."""
    words = layouts.__name__.split("_")
    id = "".join(map(str.capitalize, words)) + "Control-v0"
    short = "-".join(words)
    return TaskSet(id, short, short, (LayoutDraw(layouts),))


CONTROL_TASK_SETS = tuple(map(_control, CONTROLS))

_BUILT_IN = {entry.id: entry for entry in (*PAPER_TASK_SETS, *CONTROL_TASK_SETS)}
_task_sets = dict(_BUILT_IN)


def registered_ids() -> tuple[str, ...]:
    """Returns the ids that `make` takes: the paper's eight sets, the controls, and yours.

    Example:
      >>> tt.registered_ids()[:2]
      ('TrapTube-v0', 'PerceptualTrapTube-v0')
    """
    return tuple(_task_sets)


def task_set(name: str) -> TaskSet:
    """Returns the task set with this id, short name or label, or a mixture of sets.

    A mixture, such as "p+p+pstsy", draws every task from one of its sets. A set that is named
    twice is drawn twice as often.

    Raises:
      ValueError: no set has the name; the message lists the short names and the nearest names.

    Example:
      >>> tt.task_set("psy") == tt.task_set("{P, Sy}")
      True
      >>> tt.task_set("p+pstsy").label
      '{P} + {P, St, Sy}'
    """
    by_name = {known: entry for entry in _task_sets.values() for known in entry.names}
    if isinstance(name, str) and name in by_name:
        return by_name[name]
    if isinstance(name, str) and "+" in name:
        parts = [part.strip() for part in name.split("+")]
        if not all(parts):
            raise ValueError(f"a mixture names task sets joined by '+', got {name!r}")
        return _mixture(list(map(task_set, parts)))
    allowed = ", ".join(entry.short for entry in _task_sets.values())
    raise ValueError(
        f"unknown task set {name!r}{did_you_mean(name, by_name)}; allowed: {allowed}, or their ids "
        "(trap_tube_jax.registered_ids()); a set of yours is known once its module is imported, as "
        "by --import MODULE"
    )


def _mixture(entries: Sequence[TaskSet]) -> TaskSet:
    """Returns the set whose tasks come from one of several sets, equally often.

    Raises:
      ValueError: the sets have different step limits, or a base state of their own.
    """
    first = entries[0]
    for entry in entries:
        if entry.base is not None:
            raise ValueError(
                f"a mixture is of sets that start from the base task; {entry.short} has a base "
                "state of its own"
            )
        if entry.max_steps != first.max_steps:
            raise ValueError(
                f"a mixture is of sets that have one step limit; {first.short} has "
                f"{first.max_steps} steps, {entry.short} {entry.max_steps}"
            )
    counts = collections.Counter(compose(*entry.transfers) for entry in entries)
    return TaskSet(
        "+".join(entry.id for entry in entries),
        "+".join(entry.short for entry in entries),
        " + ".join(entry.label for entry in entries),
        (Mixture(tuple(counts), tuple(counts.values())),),
        max_steps=first.max_steps,
    )


def make(
    name: str,
    *,
    num_features: int | None = None,
    base: State | None = None,
    max_steps: int | None = None,
) -> Environment:
    """Makes the environment of a registered task set.

    Args:
      name: an id such as "PerceptualStructuralTrapTube-v0", its short name "pst", its label
        "{P, St}", or a mixture of sets such as "p+pstsy" (`task_set`).
      num_features: N, number of feature channels of the base task, 1 to 1024; 3 (RGB) if absent.
        With `base`, the palette of `base` has N channels.
      base: a base state instead of the set's.
      max_steps: a step limit instead of the set's.

    Raises:
      ValueError: naming the value and what is allowed.

    Example:
      >>> tt.make("psy")
      Environment(transfers=(perceptual, symbolic), max_steps=50)
      >>> tt.make("PerceptualTrapTube-v0", num_features=8).observation_spec.shape
      (12, 12, 8)
    """
    entry = task_set(name)
    base = entry.base if base is None else base
    if base is None:
        base = base_state(3 if num_features is None else num_features)
    max_steps = entry.max_steps if max_steps is None else max_steps
    env = Environment(entry.transfers, base=base, max_steps=max_steps)
    if num_features not in (None, env.num_features):
        raise ValueError(
            f"num_features={num_features} contradicts the base state, whose palette has "
            f"{env.num_features} features; give one of them"
        )
    return env


def register(
    id: str,
    transfers: Iterable[Transfer],
    *,
    short: str | None = None,
    base: State | None = None,
    max_steps: int = MAX_STEPS,
) -> TaskSet:
    """Adds a task set to those that `make` knows, for this process.

    Replaces a set of yours with the same id. Environments made before keep the old one.

    Args:
      id: name of the set, not one of the project's.
      transfers: functions (key, state) -> state, in the order in which they apply.
      short: name in tables and file names; the id if absent.
      base: the state that the transfers start from, at time 0; the base task if absent.
      max_steps: steps after which an unsolved episode is truncated, 1 to 2**31 - 1.

    Raises:
      ValueError: a name is taken or has other characters than letters, digits, "_", "." and
        "-", a transfer is not a function or not hashable, or the base state or the step limit is
        invalid; the message says what is allowed.

    Example:
      >>> entry = tt.register("Hasty-v0", (tt.perceptual,), short="hasty", max_steps=20)
      >>> tt.make("hasty")
      Environment(transfers=(perceptual), max_steps=20)
    """
    short = id if short is None else short
    others = [entry for entry in _task_sets.values() if entry.id != id or id in _BUILT_IN]
    taken = {name for entry in others for name in entry.names}
    for name in (id, short):
        check_registered_name("task set", name)
        if name in taken:
            raise ValueError(f"the name {name!r} is taken; taken are: {', '.join(sorted(taken))}")
    env = Environment(transfers, base=base, max_steps=max_steps)
    base = None if base is None else env.base
    _task_sets[id] = TaskSet(id, short, short, env.transfers, base, env.max_steps)
    return _task_sets[id]
