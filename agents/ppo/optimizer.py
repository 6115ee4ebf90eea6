"""Optimizer of the published baseline: Adam with epsilon added before bias correction."""

from typing import Any

import jax
import jax.numpy as jnp
import optax

from agents.config import Config

FINAL_LR_FRACTION = 1 / 50  # what a whole decay multiplies the learning rate by
BETA1 = 0.9  # decay of the first moment
BETA2 = 0.999  # decay of the second moment


def adam(learning_rate: optax.Schedule, epsilon: float) -> optax.GradientTransformation:
    """Adam with epsilon added to the root of the uncorrected second moment.

      m <- BETA1 m + (1 - BETA1) g,  v <- BETA2 v + (1 - BETA2) g^2,
      step = -learning_rate sqrt(1 - BETA2^t) / (1 - BETA1^t) * m / (sqrt(v) + epsilon).

    Kingma and Ba (2015) give this form at the end of section 2, and the baseline's framework uses
    it. `optax.adam` adds epsilon after correcting v. At t = 1, epsilon then weighs 30 times less
    (sqrt(1 - BETA2) = 0.03), which affects parameters whose gradient is near 1e-6.

    `learning_rate` is a function of the number of updates so far.
    """

    def init(params: optax.Params) -> optax.ScaleByAdamState:
        zeros = jax.tree.map(jnp.zeros_like, params)
        return optax.ScaleByAdamState(jnp.zeros((), jnp.int32), zeros, zeros)

    def update(updates: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        count = state.count + 1
        mu = optax.tree.update_moment(updates, state.mu, BETA1, 1)
        nu = optax.tree.update_moment(updates, state.nu, BETA2, 2)
        t = count.astype(jnp.float32)
        rate = jnp.asarray(learning_rate(state.count), jnp.float32)
        rate = rate * jnp.sqrt(1 - BETA2**t) / (1 - BETA1**t)
        step = jax.tree.map(lambda m, v: -rate * m / (jnp.sqrt(v) + epsilon), mu, nu)
        return step, optax.ScaleByAdamState(count, mu, nu)

    return optax.GradientTransformation(init, update)


def make_optimizer(config: Config) -> optax.GradientTransformation:
    """Builds Adam behind clipping of the gradient's global norm."""
    return optax.chain(
        optax.clip_by_global_norm(config.max_gradient_norm),
        adam(learning_rate_schedule(config), epsilon=config.adam_epsilon),
    )


def learning_rate_schedule(config: Config) -> optax.Schedule:
    """Returns the learning rate by gradient step: constant, then decaying geometrically."""
    total = config.iterations * config.gradient_steps
    decaying = round(config.lr_decay_fraction * total)
    if not decaying:
        return optax.constant_schedule(config.learning_rate)
    return optax.exponential_decay(
        config.learning_rate, decaying, FINAL_LR_FRACTION, transition_begin=total - decaying
    )
