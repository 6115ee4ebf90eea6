"""Intrinsic rewards, one module each, with the names that `Config.curiosity` allows."""

from agents.curiosity.base import Curiosity, Experience
from agents.curiosity.checks import make_curiosity
from agents.curiosity.effects import Effects
from agents.curiosity.icm import ICM
from agents.curiosity.noveld import NovelD
from agents.curiosity.rnd import RND
from agents.registry import curiosities

__all__ = ["Curiosity", "Experience", "make_curiosity", "register"]

register = curiosities.register

curiosities.update(
    {
        "icm": lambda config, env: ICM(config),
        "rnd": lambda config, env: RND(config),
        "noveld": lambda config, env: NovelD(config),
        "effects": lambda config, env: Effects(config),
        "none": lambda config, env: Curiosity(),
    }
)
