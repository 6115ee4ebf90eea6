"""The oracle: exact shortest plans and distances, by search over the public step.

A task is a deterministic graph. Its nodes are the positions of agent, tool and food, its
edges the 16 actions. The search runs on the host, and `dynamics.step` computes the edges of a
whole frontier at a time, so there is one set of rules.

    search.py      breadth-first search; shortest plans
    distance.py    distances to the goal, for every reachable state
    __main__.py    the command line: python -m trap_tube_jax.solver --help
"""

from trap_tube_jax.solver.distance import distances
from trap_tube_jax.solver.search import Plan, solve, solve_batch

__all__ = ["Plan", "distances", "solve", "solve_batch"]
