"""Curiosities for tests."""

import jax.numpy as jnp

from agents.curiosity import Curiosity


class Returning(Curiosity):
    """Returns what its constructor is given, even if that breaks the contract."""

    def __init__(self, reward=None, given=None, losses=None):
        self.memory = lambda: jnp.zeros((), jnp.int32)
        self.reward = lambda params, memory, experience: (
            experience.episodes.reward if reward is None else reward,
            memory if given is None else given,
        )
        self.losses = lambda params, experience: (
            losses
            if type(losses) is dict
            else dict.fromkeys(losses or (), experience.episodes.reward)
        )
