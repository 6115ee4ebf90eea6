"""The trap-tube task of tool use as a functional, vectorised JAX gridworld.

    import jax
    import trap_tube_jax as tt

    env = tt.make("PerceptualTrapTube-v0")
    state, timestep = env.reset(jax.random.key(0))
    print(tt.render_ascii(state))
    for action in tt.solve(state).actions:  # pairs (grasp, move): 0 up, 1 down, 2 left, 3 right
        state, timestep = env.step(state, action)
    print(timestep.reward, timestep.terminated)

`help(trap_tube_jax.make)` explains a name. Functions are pure and unbatched: jit, vmap and scan
them. The examples assume these two imports, `import jax.numpy as jnp` and `import numpy as np`.

    task sets      make, task_set, register, registered_ids, TaskSet, PAPER_TASK_SETS,
                   CONTROL_TASK_SETS
    environments   Environment, ArraySpec, AutoReset, VectorEnvironment, VectorState,
                   action_from_index, action_to_index
    states         State, TimeStep, base_state, base_palette, validate
    transfers      perceptual, structural, symbolic, graded_perceptual, graded_structural,
                   compose, Transfer
    observations   observe, visible_objects
    pictures       render, render_ascii, episode_frames, save_gif
    oracle         solve, solve_batch, Plan, distances
    scores         score, score_gymnasium, Score, Scores, evaluation_tasks

Pages in this folder: environment.md, own_tasks.md, graded.md, controls.md, protocol.md.
"""

import importlib.util
import warnings

from trap_tube_jax import registry, transfers
from trap_tube_jax._version import __version__ as __version__
from trap_tube_jax.environment import ArraySpec, Environment, action_from_index, action_to_index
from trap_tube_jax.graded import graded_perceptual, graded_structural
from trap_tube_jax.objects import base_palette
from trap_tube_jax.observation import observe, render_ascii, visible_objects
from trap_tube_jax.registry import (
    TaskSet,
    make,
    register,
    registered_ids,
    task_set,
)
from trap_tube_jax.rendering import episode_frames, render, save_gif
from trap_tube_jax.scoring.benchmark import score, score_gymnasium
from trap_tube_jax.scoring.scores import Score, Scores
from trap_tube_jax.scoring.tasks import evaluation_tasks
from trap_tube_jax.solver import Plan, distances, solve, solve_batch
from trap_tube_jax.state import State, TimeStep, base_state, validate
from trap_tube_jax.transfers import compose, perceptual, structural, symbolic
from trap_tube_jax.vector import VectorEnvironment, VectorState
from trap_tube_jax.wrappers import AutoReset

__all__ = [
    "CONTROL_TASK_SETS",
    "PAPER_TASK_SETS",
    "ArraySpec",
    "AutoReset",
    "Environment",
    "Plan",
    "Score",
    "Scores",
    "State",
    "TaskSet",
    "TimeStep",
    "Transfer",
    "VectorEnvironment",
    "VectorState",
    "action_from_index",
    "action_to_index",
    "base_palette",
    "base_state",
    "compose",
    "distances",
    "episode_frames",
    "evaluation_tasks",
    "graded_perceptual",
    "graded_structural",
    "make",
    "observe",
    "perceptual",
    "register",
    "registered_ids",
    "render",
    "render_ascii",
    "save_gif",
    "score",
    "score_gymnasium",
    "solve",
    "solve_batch",
    "structural",
    "symbolic",
    "task_set",
    "validate",
    "visible_objects",
]

PAPER_TASK_SETS = registry.PAPER_TASK_SETS
"""The paper's eight task sets; the first is the base task alone.

Example:
  >>> [entry.short for entry in tt.PAPER_TASK_SETS]
  ['base', 'p', 'st', 'sy', 'pst', 'psy', 'stsy', 'pstsy']
"""

CONTROL_TASK_SETS = registry.CONTROL_TASK_SETS
"""The controls of comparative psychology, which controls.md describes.

Example:
  >>> [entry.short for entry in tt.CONTROL_TASK_SETS[:3]]
  ['trap-turned', 'trap-exchanged', 'no-trap']
"""

Transfer = transfers.Transfer
"""A pure function (key, state) -> state, which `Environment.reset` applies.

It is hashable and runs under jit. The state it returns is valid and at time 0.

Example:
  >>> def far_agent(key, state):
  ...     return state.replace(agent=jnp.array([0, 11]))
  >>> state, timestep = tt.Environment((far_agent,)).reset(jax.random.key(0))
  >>> state.agent.tolist()
  [0, 11]
"""


def _register_with_gymnasium() -> None:
    """Follows Gymnasium's convention: importing a package registers its environments."""
    if importlib.util.find_spec("gymnasium") is None:
        return
    try:
        importlib.import_module("trap_tube_jax.adapters.to_gymnasium")
    except Exception as error:  # an old or broken one must not keep the environment from users
        warnings.warn(f"no task set is registered with Gymnasium: {error}", stacklevel=2)


_register_with_gymnasium()


def __dir__() -> list[str]:
    return __all__
