"""Intrinsic rewards, one module each, with the names that `Config.curiosity` allows."""

from agents.curiosity.base import Curiosity, Experience
from agents.curiosity.counts import Counts
from agents.curiosity.e3b import E3B
from agents.curiosity.effects import Effects
from agents.curiosity.icm import ICM
from agents.curiosity.icm_detached import DetachedICM
from agents.curiosity.noveld import NovelD
from agents.curiosity.ride import RIDE
from agents.curiosity.rnd import RND
from agents.registry import curiosities

__all__ = ["Curiosity", "Experience", "register"]

register = curiosities.register

curiosities.update(
    {
        "icm": lambda config, env: ICM(config),
        "icm-detached": lambda config, env: DetachedICM(config),
        "rnd": lambda config, env: RND(config),
        "noveld": lambda config, env: NovelD(config),
        "ride": lambda config, env: RIDE(config),
        "e3b": lambda config, env: E3B(config),
        "effects": lambda config, env: Effects(config),
        "counts": lambda config, env: Counts(env),
        "none": lambda config, env: Curiosity(),
    }
)
