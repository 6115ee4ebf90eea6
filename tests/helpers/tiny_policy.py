"""A tiny random policy on grey boards, and tasks some of which any policy solves."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import trap_tube_jax as tt
from agents import Config, Policy
from agents.networks.agent import Agent

STEPS = 12
CONFIG = Config(
    env_id="SymbolicTrapTube-v0",
    num_features=1,
    max_steps=STEPS,
    filters=(2, 2),
    hidden=4,
    embedding=2,
    curiosity="none",
)
# The food is next to the agent, on one of four sides: any first move solves one of the tasks.
FOOD_CELLS = [(8, 1), (10, 1), (9, 0), (9, 2)]


def random_params(config: Config = CONFIG, seed: int = 3) -> Any:
    """Returns random parameters without compiling their initialisation."""
    shapes = jax.eval_shape(Agent(config).init, jax.random.key(0))
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), x.dtype), shapes)


def random_policy(seed: int = 3, **settings: Any) -> Policy:
    """Returns a policy of random parameters, `settings` differing from `CONFIG`."""
    config = dataclasses.replace(CONFIG, **settings)
    return Policy(config, random_params(config, seed), 1)


def food_next_to_agent(num_features: int = 1) -> tt.State:
    """Returns four tasks, with the food at each of `FOOD_CELLS`."""
    base = tt.base_state(num_features)
    states = [base.replace(food=jnp.array(cell, jnp.int32)) for cell in FOOD_CELLS]
    return jax.tree.map(lambda *x: jnp.stack(x), *states)
