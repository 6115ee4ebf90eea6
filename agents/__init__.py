"""Agents that learn the trap-tube task: PPO with curiosity, jitted end to end.

import agents, jax

config = agents.Config.preset("fast", env_id="sy")
learner = agents.make_learner(config)           # init and iterate, pure functions
policy = agents.load("best-pstsy")              # a shipped agent, a run's folder or a file
action, carry = policy.act(observation, policy.initial(batch))
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
