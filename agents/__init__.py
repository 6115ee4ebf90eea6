"""Agents that learn the trap-tube task: PPO with curiosity, jitted end to end."""

from agents.acting.policy import Policy
from agents.config import Config
from agents.ppo.learner import Learner, TrainState, make_learner
from agents.runs.loading import load, save
from agents.runs.results import results

__all__ = ["Config", "Learner", "Policy", "TrainState", "load", "make_learner", "results", "save"]
