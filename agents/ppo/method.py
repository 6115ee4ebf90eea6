"""What every method of training provides: two pure functions and what they are made of."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from agents.config import Config
from agents.networks.agent import Agent
from agents.parallel.sharding import Shards
from trap_tube_jax.environment import Environment
from trap_tube_jax.registry import make

Metrics = dict[str, jax.Array]


class Train(NamedTuple):
    """Training as two pure functions; jit them, and vmap them over seeds.

    Attributes:
      init: PRNG key to the first state. A state holds all that training carries from one
        iteration to the next, among it `params`, and i32[] each: `iteration`, the iterations
        done, `episodes`, those played, and `transitions`, environment steps of episodes.
      iterate: a state to the next one and its metrics, f32[] each.
      agent: the network's functions.
      env: the environment.
      config: the settings.
      shards: how `iterate` divides its episodes over devices.
    """

    init: Callable[[jax.Array], Any]
    iterate: Callable[[Any], tuple[Any, Metrics]]
    agent: Agent
    env: Environment
    config: Config
    shards: Shards


def environment(config: Config, env: Environment | None) -> Environment:
    """The environment to train in: `env`, or that of `config.env_id` if absent.

    Raises:
      ValueError: `env` contradicts `config`.
    """
    if env is None:
        return make(config.env_id, num_features=config.num_features, max_steps=config.max_steps)
    for name in ("num_features", "max_steps"):
        if getattr(env, name) != getattr(config, name):
            raise ValueError(
                f"the environment's {name} is {getattr(env, name)}, the config's "
                f"{getattr(config, name)}; they must agree"
            )
    return env
