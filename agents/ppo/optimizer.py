"""The published baseline's optimiser: Adam with epsilon added before the correction of bias."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from agents.config import Config

LAST_STEP_SIZE = 1 / 50  # of the last gradient step of a cooldown, as a fraction of the first
BETA1, BETA2 = 0.9, 0.999  # decay of Adam's moments


class AdamState(NamedTuple):
    """Adam's moments.

    Attributes:
      updates: i32[], how many so far.
      first: moving averages of the gradients.
      second: moving averages of their squares.
    """

    updates: jax.Array
    first: optax.Params
    second: optax.Params


def adam(learning_rate: optax.Schedule, epsilon: float) -> optax.GradientTransformation:
    """Adam with epsilon added to the root of the uncorrected second moment.

      m <- BETA1 m + (1 - BETA1) g,  v <- BETA2 v + (1 - BETA2) g^2,
      step = -learning_rate sqrt(1 - BETA2^t) / (1 - BETA1^t) * m / (sqrt(v) + epsilon).

    This is the form at the end of section 2 of Kingma and Ba (2015), which the baseline's
    framework uses. `optax.adam` adds epsilon after the correction of v. At t = 1 epsilon
    then weighs 30 times less (sqrt(1 - BETA2) = 0.03), which shows in parameters whose gradient is
    near 1e-6.

    Args:
      learning_rate: step size, by the number of updates so far.
      epsilon: added to the root of the second moment.
    """

    def init(params: optax.Params) -> AdamState:
        zeros = jax.tree.map(jnp.zeros_like, params)
        return AdamState(jnp.zeros((), jnp.int32), zeros, zeros)

    def update(updates: Any, state: Any, params: Any = None) -> tuple[Any, AdamState]:
        count = state.updates + 1
        first = optax.tree.update_moment(updates, state.first, BETA1, 1)
        second = optax.tree.update_moment(updates, state.second, BETA2, 2)
        rate = learning_rate(state.updates) * jnp.sqrt(1 - BETA2**count) / (1 - BETA1**count)
        step = jax.tree.map(lambda m, v: -rate * m / (jnp.sqrt(v) + epsilon), first, second)
        return step, AdamState(count, first, second)

    return optax.GradientTransformation(init, update)


def make_optimizer(config: Config) -> optax.GradientTransformation:
    """Adam behind a clip of the gradients' global norm."""
    return optax.chain(
        optax.clip_by_global_norm(config.max_gradient_norm),
        adam(step_size(config), epsilon=config.adam_epsilon),
    )


def step_size(config: Config) -> optax.Schedule:
    """The learning rate by gradient steps: constant, then falling geometrically in the cooldown."""
    total = config.iterations * config.gradient_steps
    falling = round(config.lr_decay_fraction * total)
    if not falling:
        return optax.constant_schedule(config.learning_rate)
    return optax.exponential_decay(
        config.learning_rate, falling, LAST_STEP_SIZE, transition_begin=total - falling
    )
