"""The oracle as an upper bound: which tasks can be solved at all, and in how many steps.

python -m agents.examples.oracle
"""

from collections.abc import Sequence

import jax
import numpy as np

import agents
import trap_tube_jax as tt


def main(sets: Sequence[str] = ("base", "sy", "p"), tasks: int = 20) -> dict[str, float]:
    """Searches shortest plans, then scores the agent shipped as `base` beside them.

    Args:
      sets: ids or short names of task sets.
      tasks: how many of each set.

    Returns:
      By set, the percent of the tasks that can be solved within the step limit.
    """
    bounds = {}
    for name in sets:
        env = tt.make(name)
        states, _ = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), tasks))
        plans = tt.solve_batch(states)
        solved = plans.solvable & (plans.length <= env.max_steps)
        bounds[name] = 100 * float(np.mean(solved))
        steps = np.mean(plans.length[solved])
        print(f"{name}: {bounds[name]:.1f} % can be solved, in {steps:.1f} steps on average")
    print(tt.score(agents.load("base"), sets=sets, tasks=tasks, optimality=tasks))
    return bounds


if __name__ == "__main__":
    main()
