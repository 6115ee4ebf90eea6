"""Shortest plans as an upper bound of an agent's score.

python -m agents.examples.oracle
"""

import argparse
from collections.abc import Sequence

import jax
import numpy as np

import agents
import trap_tube_jax as tt


def main(sets: Sequence[str] = ("base", "sy", "p"), tasks: int = 20) -> dict[str, float]:
    """Scores the shipped agent `fast-base`; returns percent of tasks that some plan solves."""
    bounds = {}
    for name in sets:
        env = tt.make(name)
        states, _ = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), tasks))
        plans = tt.solve_batch(states)
        solved = plans.solvable & (plans.length <= env.max_steps)
        bounds[name] = 100 * float(np.mean(solved))
        steps = np.mean(plans.length[solved])
        print(f"{name}: {bounds[name]:.1f} % can be solved, in {steps:.1f} steps on average")
    print(tt.score(agents.load("fast-base"), sets=sets, tasks=tasks, optimality=tasks))
    return bounds


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    main()
