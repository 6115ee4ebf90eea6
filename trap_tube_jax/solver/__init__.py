"""The oracle: exact shortest plans and distances, by search over the public step.

A task is a deterministic graph: its nodes are the places of food, tool and agent, its
edges the 16 actions. Everything here runs on the host and steps whole frontiers at once
through `dynamics.step`, so that there is one set of rules.

    search.py      breadth-first search; shortest plans
    distance.py    distances from the start and to the goal, for every reachable state
    survey.py      the figures of a task set
    pictures.py    what the command line draws
    __main__.py    the command line: python -m trap_tube_jax.solver --help
"""

from trap_tube_jax.solver.distance import Distances, distances
from trap_tube_jax.solver.search import Plan, solve, solve_batch

__all__ = ["Distances", "Plan", "distances", "solve", "solve_batch"]
