"""The difficulty of a task set: shortest plans of many of its tasks.

Source: environment.md, "Task sets", has the statistics of the paper's eight.
"""

import dataclasses
from typing import Any

import jax
import numpy as np

from trap_tube_jax.checks import check_integer, check_seed
from trap_tube_jax.registry import TaskSet, make
from trap_tube_jax.solver.search import solve_batch
from trap_tube_jax.state import State

QUANTILES = (5, 25, 50, 75, 95)


@dataclasses.dataclass(frozen=True)
class Survey:
    """Shortest plans of tasks drawn from a set.

    Attributes:
      task_set: the set.
      seed: the seed of the tasks.
      length: i32[T], length of every task's shortest plan; -1 if unsolvable.
    """

    task_set: TaskSet
    seed: int
    length: np.ndarray

    @property
    def solved_length(self) -> np.ndarray:
        """Returns the lengths i32[S] of the solvable tasks' shortest plans."""
        return self.length[self.length >= 0]

    def summary(self) -> dict[str, Any]:
        """Returns statistics as plain numbers, None where there is nothing to average."""
        solved = self.solved_length
        quantiles = np.percentile(solved, QUANTILES) if len(solved) else [None] * len(QUANTILES)
        return {
            "id": self.task_set.id,
            "tasks": len(self.length),
            "seed": self.seed,
            "solvable": len(solved) / len(self.length),
            "mean": solved.mean().item() if len(solved) else None,
            "quantiles": dict(zip(map(str, QUANTILES), quantiles, strict=True)),
            "longest": solved.max().item() if len(solved) else None,
        }


def survey(task_set: TaskSet, *, tasks: int, seed: int = 0) -> Survey:
    """Solves tasks of a set.

    Args:
      task_set: the set; its id is registered.
      tasks: number of tasks, at least 1.
      seed: 0 to 2**32 - 1; the tasks are those of the keys
        `jax.random.split(jax.random.key(seed), tasks)`.

    Raises:
      ValueError: a number is out of range; the message names the range.
    """
    tasks = check_integer("tasks", tasks)
    seed = check_seed(seed)
    return Survey(task_set, seed, solve_batch(draw_tasks(task_set, tasks, seed)).length)


def draw_tasks(task_set: TaskSet, tasks: int, seed: int) -> State:
    """Draws the first states of tasks of a set, with a leading axis, as NumPy arrays."""
    env = make(task_set.id)
    keys = jax.random.split(jax.random.key(seed), tasks)
    return jax.device_get(jax.jit(jax.vmap(lambda key: env.reset(key)[0]))(keys))
