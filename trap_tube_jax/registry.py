"""The task sets by name: the paper's eight, and your own.

Source: paper, section "Experimental Setup"; environment.md, "Task sets".
"""

import dataclasses
from collections.abc import Sequence

from trap_tube_jax.environment import Environment
from trap_tube_jax.objects import MAX_STEPS
from trap_tube_jax.state import State, base_state, check_structure
from trap_tube_jax.transfers import Transfer, perceptual, structural, symbolic


@dataclasses.dataclass(frozen=True)
class TaskSet:
    """A named set of transfers.

    Attributes:
      id: the name that `make` takes.
      short: the name in tables and file names.
      transfers: the transfers, in the order in which they apply.
    """

    id: str
    short: str
    transfers: tuple[Transfer, ...]

    @property
    def label(self) -> str:
        """The set in the paper's notation, as in "{P, St}"; "base" for no transfers."""
        symbols: dict[Transfer, str] = {perceptual: "P", structural: "St", symbolic: "Sy"}
        names = (
            symbols.get(transfer, getattr(transfer, "__name__", "?")) for transfer in self.transfers
        )
        return "{" + ", ".join(names) + "}" if self.transfers else "base"


PAPER_TASK_SETS = (
    TaskSet("TrapTube-v0", "base", ()),
    TaskSet("PerceptualTrapTube-v0", "p", (perceptual,)),
    TaskSet("StructuralTrapTube-v0", "st", (structural,)),
    TaskSet("SymbolicTrapTube-v0", "sy", (symbolic,)),
    TaskSet("PerceptualStructuralTrapTube-v0", "pst", (perceptual, structural)),
    TaskSet("PerceptualSymbolicTrapTube-v0", "psy", (perceptual, symbolic)),
    TaskSet("StructuralSymbolicTrapTube-v0", "stsy", (structural, symbolic)),
    TaskSet("PerceptualStructuralSymbolicTrapTube-v0", "pstsy", (perceptual, structural, symbolic)),
)

_task_sets = {task_set.id: task_set for task_set in PAPER_TASK_SETS}


def registered_ids() -> tuple[str, ...]:
    """The ids that `make` takes: the paper's eight first, then your own."""
    return tuple(_task_sets)


def task_set(name: str) -> TaskSet:
    """The task set with this id or short name.

    Raises:
      ValueError: there is none; the message lists all.
    """
    for candidate in _task_sets.values():
        if name in (candidate.id, candidate.short):
            return candidate
    allowed = ", ".join(f"{entry.id} ({entry.short})" for entry in _task_sets.values())
    raise ValueError(f"unknown task set {name!r}; allowed: {allowed}")


def make(
    name: str,
    *,
    num_features: int = 3,
    base: State | None = None,
    max_steps: int = MAX_STEPS,
) -> Environment:
    """Makes the environment of a registered task set.

    Args:
      name: an id such as "PerceptualTrapTube-v0", or its short name such as "p".
      num_features: N >= 1, the feature channels of the base task; 3 for RGB.
      base: another base state, whose palette then sets N.
      max_steps: steps after which an unsolved episode is truncated.

    Raises:
      ValueError: naming the value and what is allowed.
    """
    transfers = task_set(name).transfers
    if base is None:
        base = base_state(num_features)
    check_structure(base)
    if num_features not in (3, base.palette.shape[-1]):
        raise ValueError(
            f"num_features={num_features} contradicts base, whose palette has "
            f"{base.palette.shape[-1]} features; give one of them"
        )
    return Environment(transfers, base=base, max_steps=max_steps)


def register(id: str, transfers: Sequence[Transfer], *, short: str | None = None) -> TaskSet:
    """Adds a task set of your own to those that `make` knows, for this process.

    Args:
      id: its name, not yet taken.
      transfers: functions (key, state) -> state, in the order in which they apply.
      short: its name in tables; the id if absent.

    Raises:
      ValueError: a name is empty or taken, or a transfer is none.
    """
    short = id if short is None else short
    taken = {name for entry in _task_sets.values() for name in (entry.id, entry.short)}
    for name in (id, short):
        if not isinstance(name, str) or not name:
            raise ValueError(f"a task set's name must be a non-empty string, got {name!r}")
        if name in taken:
            raise ValueError(f"the name {name!r} is taken; taken are: {', '.join(sorted(taken))}")
    Environment(transfers)
    _task_sets[id] = TaskSet(id, short, tuple(transfers))
    return _task_sets[id]
