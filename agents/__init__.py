"""Agents that learn the trap-tube task: PPO with curiosity, end-to-end jitted."""

from agents.config import Config
from agents.ppo.learner import TrainState, make_train
from agents.ppo.method import Train

__all__ = ["Config", "Train", "TrainState", "make_train"]
