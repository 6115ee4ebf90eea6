"""The policy network; its encoders by the names that `Config.encoder` knows."""

from agents.networks.encoder import Encoder
from agents.networks.object_encoder import ObjectEncoder
from agents.registry import encoders

__all__ = ["register"]

register = encoders.register

register("paper", lambda config: Encoder(config.filters))
register("objects", lambda config: ObjectEncoder(config.filters))
