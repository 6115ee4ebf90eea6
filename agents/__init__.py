"""Agents that learn the trap-tube task: PPO with curiosity, end-to-end jitted."""
