"""Intrinsic rewards, one module each, by the names that `Config.curiosity` knows."""

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

register("icm", lambda config, env: ICM(config))
register("icm-detached", lambda config, env: DetachedICM(config))
register("rnd", lambda config, env: RND(config))
register("noveld", lambda config, env: NovelD(config))
register("ride", lambda config, env: RIDE(config))
register("e3b", lambda config, env: E3B(config))
register("effects", lambda config, env: Effects(config))
register("counts", lambda config, env: Counts(env))
register("none", lambda config, env: Curiosity())
