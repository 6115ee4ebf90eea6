"""Agents that learn the trap-tube task: PPO with curiosity, end-to-end jitted."""

from agents.acting.policy import Policy
from agents.config import Config
from agents.ppo.method import Train
from agents.runs.loading import load
from agents.training import TrainState, make_train

__all__ = ["Config", "Policy", "Train", "TrainState", "load", "make_train"]
