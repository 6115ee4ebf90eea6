"""Memory that training needs, estimated before it is allocated."""

import math

import jax

from agents.config import Config
from agents.ppo.learner import make_train
from trap_tube_jax.objects import BOARD_SIZE

ACTIVATIONS = 16  # f32[hidden] per step of a minibatch, kept for the gradient


def memory_estimate(config: Config) -> int:
    """Estimates the bytes that one seed needs, within a factor of three.

    Counts the training state, the boards and GRU outputs of an iteration's episodes, and the
    activations of a minibatch, which were fitted to XLA's own figures for the presets.
    """
    learner = make_train(config)
    state = jax.eval_shape(learner.init, jax.random.key(0))
    times = learner.env.max_steps + 1
    played = BOARD_SIZE**2 * config.num_features + 4 * config.hidden
    learned = ACTIVATIONS * 4 * config.hidden
    steps = config.episodes_per_iteration * played + config.minibatch_size * learned
    return sum(4 * math.prod(x.shape) for x in jax.tree.leaves(state)) + times * steps
