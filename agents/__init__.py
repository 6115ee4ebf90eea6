"""Agents that learn the trap-tube task: PPO with curiosity, end-to-end jitted."""

from agents.config import Config
from agents.ppo.learner import Train, TrainState, make_train

__all__ = ["Config", "Train", "TrainState", "make_train"]
