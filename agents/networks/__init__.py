"""The policy network. Its encoders have the names that `Config.encoder` allows."""

import flax.linen as nn

from agents.config import Config
from agents.networks.encoder import Encoder
from agents.networks.object_encoder import ObjectEncoder
from agents.registry import encoders

__all__ = ["make_encoder", "register"]

register = encoders.register

encoders["paper"] = lambda config: Encoder(config.filters)
encoders["objects"] = lambda config: ObjectEncoder(config.filters, config.object_colors)


def make_encoder(config: Config) -> nn.Module:
    """Builds the encoder that `config.encoder` names; no two calls share parameters.

    Raises:
      ValueError: the registered factory does not return a Flax Linen module.
    """
    module = encoders.factory(config.encoder)(config)
    if not isinstance(module, nn.Module):
        raise ValueError(
            f"encoder {config.encoder!r} must be a flax.linen.Module, got {type(module).__name__}"
        )
    return module.clone()
