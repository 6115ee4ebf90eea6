"""Tasks of several sets that one program plays: blocks, step limits and scores.

Source: protocol.md, "Solving".
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, Self, TypeVar

import numpy as np

from trap_tube_jax._version import __version__
from trap_tube_jax.registry import task_set
from trap_tube_jax.scoring.scores import Optimality, Score, Scores
from trap_tube_jax.scoring.tasks import (
    PROTOCOL,
    Purpose,
    evaluation_tasks,
    label,
    layout_numbers,
)
from trap_tube_jax.state import State, concatenate_trees, take

BLOCK = 1024  # tasks played at once, which bounds the memory


class Outcome(Protocol):
    """The ends of B episodes: a NamedTuple of arrays [B, ...], with at least these fields.

    Attributes:
      solved: bool[B].
      length: i32[B], steps taken.
    """

    @property
    def solved(self) -> Any: ...  # noqa: D102
    @property
    def length(self) -> Any: ...  # noqa: D102
    def _replace(self, **changes: Any) -> Self: ...


Played = TypeVar("Played", bound=Outcome)
Record = TypeVar("Record")


@dataclasses.dataclass(frozen=True)
class Suite:
    """Tasks of one or more sets, to be played and scored.

    Attributes:
      tasks: by short name, the states [B] of a set at time 0.
      max_steps: by short name, the step limit of a set.

    Raises:
      ValueError: there is no set.
    """

    tasks: Mapping[str, State]
    max_steps: Mapping[str, int]

    def __post_init__(self):
        if not self.tasks:
            raise ValueError("there is no task to play; name at least one task set")

    @classmethod
    def of_sets(
        cls,
        sets: Sequence[str],
        num_tasks: int,
        *,
        num_features: int | None = None,
        purpose: Purpose = "test",
    ) -> Self:
        """Draws the fixed tasks of registered sets, by id, short name or label.

        Raises:
          ValueError: see `evaluation_tasks`.
        """
        entries = [task_set(name) for name in sets]
        return cls(
            tasks={
                entry.short: evaluation_tasks(entry.id, num_tasks, num_features, purpose)
                for entry in entries
            },
            max_steps={entry.short: entry.max_steps for entry in entries},
        )

    @property
    def longest(self) -> int:
        """The largest step limit, up to which a program plays."""
        return max(self.max_steps[name] for name in self.tasks)

    def play(self, program: Callable[[State], Played]) -> dict[str, Played]:
        """Plays the tasks of all sets together, and returns their outcomes by short name.

        Steps beyond a set's limit do not count: an episode that needs them is not solved.

        Args:
          program: maps b states at time 0 to an `Outcome` of b episodes of at most `longest` steps.
            b is the same in all calls, so that a jitted program compiles once.
        """
        together = concatenate_trees(self.tasks.values())
        whole = play_blocks(lambda states, _: program(states), together)
        outcomes = {}
        start = 0
        for name, states in self.tasks.items():
            end = start + len(states.time)
            outcomes[name] = _limited(take(whole, slice(start, end)), self.max_steps[name])
            start = end
        return outcomes

    def scores(
        self,
        outcomes: Mapping[str, Outcome],
        *,
        shortest: Mapping[str, np.ndarray] | None = None,
        seed: int | None = None,
    ) -> Scores:
        """Scores outcomes such as `play` returns, by short name.

        Args:
          outcomes: the outcome of every task of some of the sets.
          shortest: lengths of the shortest plans of a set's first tasks, i32[K], -1 for none.
          seed: the seed of the draws of a stochastic policy.
        """
        made = []
        for name, outcome in outcomes.items():
            solved, length = np.asarray(outcome.solved), np.asarray(outcome.length)
            found = None
            if shortest is not None:
                part = slice(len(shortest[name]))
                found = Optimality.of(
                    solved[part], length[part], shortest[name], self.max_steps[name]
                )
            layout = layout_numbers(name, self.tasks[name])
            made.append(
                Score.of(name, label(name), solved, length, layout=layout, optimality=found)
            )
        return Scores(PROTOCOL, __version__, seed, tuple(made))


def play_blocks(program: Callable[[State, int], Record], tasks: State) -> Record:
    """Plays T tasks by a program for blocks of b, and returns NumPy arrays [T, ...].

    Args:
      program: maps b states and the index of the first to a tree of arrays [b, ...]. b is the same
        in all calls, so that a jitted program compiles once.
      tasks: states [T] at time 0.
    """
    total = len(tasks.time)
    played = [program(take(tasks, block), int(block[0])) for block in blocks(total)]
    return take(concatenate_trees(played), slice(total))


def blocks(total: int) -> list[np.ndarray]:
    """Returns the indices of `total` tasks in blocks i64[b] that are played at once.

    All blocks have one size, the smaller of `BLOCK` and `total`, so that they share a compilation.
    The last block is filled up with the first tasks.
    """
    size = min(BLOCK, total)
    return [np.arange(start, start + size) % total for start in range(0, total, size)]


def _limited(outcome: Played, max_steps: int) -> Played:
    return outcome._replace(
        solved=outcome.solved & (outcome.length <= max_steps),
        length=np.minimum(outcome.length, max_steps),
    )
