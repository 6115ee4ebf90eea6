"""Agents that learn the trap-tube task: PPO with curiosity, jitted end to end.

    import agents
    import jax

    learner = agents.make_learner(agents.Config.preset("fast", env_id="sy"))
    train_state = learner.init(jax.random.key(0))
    train_state, metrics = jax.jit(learner.iterate)(train_state)

`help(agents.load)` explains a name. The examples assume these two imports and
`import trap_tube_jax as tt`.

    settings       Config
    training       make_learner, Learner, TrainState
    policies       load, save, Policy
    runs           train_run, Run, RunOptions, results

extending.md in this folder adds intrinsic rewards and encoders.
"""

from agents.acting.policy import Policy
from agents.config import Config
from agents.ppo.learner import Learner, TrainState, make_learner
from agents.runs.loading import load, save
from agents.runs.results import results
from agents.runs.run import Run, RunOptions
from agents.runs.session import train_run

__all__ = [
    "Config",
    "Learner",
    "Policy",
    "Run",
    "RunOptions",
    "TrainState",
    "load",
    "make_learner",
    "results",
    "save",
    "train_run",
]


def __dir__() -> list[str]:
    return __all__
