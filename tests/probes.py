"""Tiny environments, each solvable only by an agent with one certain ability.

They keep the trap-tube's states and observations, and replace what a step does.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

import trap_tube_jax as tt
from trap_tube_jax.state import TimeStep

# (cue, time, action) -> reward
Reward = Callable[[jax.Array, jax.Array, jax.Array], jax.Array]

CUE_UNIT = 1_000  # the hidden cue rides along in the state's time, which no observation shows


class Probe(tt.Environment):
    """A clock that pays by a function of cue, time and action.

    The agent's place on the lowest row shows the time. Where the probe is `cued`, a random
    bit is shown at time 0 only, as the food's place.
    """

    def __init__(self, max_steps: int, reward: Reward, *, cued: bool = False):
        super().__init__(max_steps=max_steps)
        self.reward = reward
        self.cued = cued

    def reset(self, key: jax.Array) -> tuple[tt.State, TimeStep]:
        state, timestep = super().reset(key)
        cue = jax.random.bernoulli(key).astype(jnp.int32) * self.cued
        state = state.replace(
            food=jnp.stack([jnp.int32(5), 5 + cue]),
            agent=jnp.array([11, 0]),
            time=CUE_UNIT * cue,
        )
        return state, timestep.replace(observation=tt.observe(state))

    def step(self, state: tt.State, action: jax.Array) -> tuple[tt.State, TimeStep]:
        cue, time = state.time // CUE_UNIT, state.time % CUE_UNIT
        reward = jnp.where(state.truncated, 0.0, self.reward(cue, time, action))
        state = state.replace(
            food=jnp.array([5, 5]),
            agent=jnp.stack([jnp.int32(11), time + 1]),
            time=state.time + 1,
            truncated=time + 1 >= self.max_steps,
        )
        return state, TimeStep(
            observation=tt.observe(state),
            reward=reward,
            terminated=state.terminated,
            truncated=state.truncated,
            discount=jnp.ones(()),
        )


def value_probe() -> Probe:
    """One step that pays 1 whatever is done: the value must become 1."""
    return Probe(1, lambda cue, time, action: jnp.ones(()))


def discount_probe() -> Probe:
    """Two steps, the second pays 1: the first value must become the discounted second."""
    return Probe(2, lambda cue, time, action: (time == 1).astype(jnp.float32))


def policy_probe() -> Probe:
    """One step that pays for one of the 16 actions."""
    return Probe(1, lambda cue, time, action: jnp.all(action == jnp.array([2, 1])) * 1.0)


def cue_probe() -> Probe:
    """One step that pays for naming the cue that is in sight."""
    return Probe(1, lambda cue, time, action: (action[0] == cue) * 1.0, cued=True)


def credit_probe() -> Probe:
    """Five steps; each asks for its own grasp, and each pays a little: no step alone matters."""
    return Probe(5, lambda cue, time, action: (action[0] == time % 4) * 1.0)


def memory_probe() -> Probe:
    """Three steps: see the cue, do action (0, 0) whatever it is, name the cue.

    The middle action earns less than a wrong one costs, so that the cue cannot be carried
    over in the previous action, which the network sees.
    """

    def reward(cue: jax.Array, time: jax.Array, action: jax.Array) -> jax.Array:
        waits = jnp.where(jnp.all(action == 0), 0.0, -1.0)
        names = (action[0] == cue) * 1.0
        return jnp.where(time == 1, waits, jnp.where(time == 2, names, 0.0))

    return Probe(3, reward, cued=True)
