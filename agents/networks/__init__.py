"""The policy network. Its encoders have the names that `Config.encoder` allows."""

import flax.linen as nn

from agents.config import Config
from agents.networks.encoder import Encoder
from agents.networks.object_encoder import ObjectEncoder
from agents.registry import encoders

__all__ = ["make_encoder", "register"]

register = encoders.register

encoders["paper"] = lambda config: Encoder(config.filters)
encoders["objects"] = lambda config: ObjectEncoder(config.filters)


def make_encoder(config: Config) -> nn.Module:
    """Builds the encoder that `config.encoder` names."""
    return encoders.factory(config.encoder)(config)
