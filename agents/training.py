"""The methods of training by name."""

from agents.config import Config
from agents.dagger import learner as dagger
from agents.parallel.sharding import ALONE, Shards
from agents.ppo import learner as ppo
from agents.ppo.method import Train
from trap_tube_jax.environment import Environment

TrainState = ppo.TrainState | dagger.TrainState
METHODS = {"ppo": ppo.make_train, "dagger": dagger.make_train}


def make_train(config: Config, env: Environment | None = None, shards: Shards = ALONE) -> Train:
    """Builds training by `config.method` from its settings.

    Args:
      config: the settings.
      env: an environment of your own; that of `config.env_id` if absent.
      shards: how to divide the episodes; more than one only within `Placement.shard`.

    Raises:
      ValueError: `env` contradicts `config`.
    """
    return METHODS[config.method](config, env, shards)
