"""Tiny environments that only an agent with one certain ability solves.

They keep the trap-tube's states and observations, and replace what a step does. All are
one environment of three steps whose kind is an array, so that they compile together.
"""

import jax
import jax.numpy as jnp

import trap_tube_jax as tt
from trap_tube_jax.state import TimeStep

STEPS = 3
KINDS = ("value", "discount", "policy", "cue", "credit", "memory")
HIDDEN_UNIT = 1_000  # a hidden bit rides along in the state's time, which no observation shows


class Probe(tt.Environment):
    """A clock that pays by a function of a hidden bit, time and action.

    The agent's place on the lowest row shows the time.

    value: pays 1 at time 0, whatever is done: the first value must become 1.
    discount: pays 1 at time 2: earlier values must become the discounted last.
    policy: pays for one of the 16 actions at time 0.
    cue: pays for naming a random bit that is in sight, at time 0.
    credit: pays at time 2 for what was done at time 0.
    memory: a random bit, in sight at time 0 only, is to be named at time 2. At time 1 any
      action but (0, 0) costs more than there is to earn, so that the bit cannot be carried
      over in the previous action, which the network sees.
    """

    def __init__(self, kind: jax.Array):
        super().__init__(max_steps=STEPS)
        self.kind = kind

    def reset(self, key: jax.Array) -> tuple[tt.State, TimeStep]:
        state, timestep = super().reset(key)
        has_cue = self._is("cue") | self._is("memory")
        bit = (jax.random.bernoulli(key) & has_cue).astype(jnp.int32)
        state = state.replace(
            food=jnp.stack([jnp.int32(5), 5 + bit]),
            agent=jnp.array([11, 0], jnp.int32),
            time=HIDDEN_UNIT * bit,
        )
        return state, timestep.replace(observation=tt.observe(state))

    def step(self, state: tt.State, action: jax.Array) -> tuple[tt.State, TimeStep]:
        bit = state.time // HIDDEN_UNIT
        time = state.time % HIDDEN_UNIT
        chosen = self._is("credit") & (time == 0)
        bit = jnp.where(chosen, (action[0] == 3).astype(jnp.int32), bit)
        reward = self._reward(bit, time, action)
        state = state.replace(
            food=jnp.array([5, 5], jnp.int32),
            agent=jnp.stack([jnp.int32(11), time + 1]),
            time=HIDDEN_UNIT * bit + time + 1,
            truncated=time + 1 >= STEPS,
        )
        return state, TimeStep(
            observation=tt.observe(state),
            reward=reward,
            terminated=state.terminated,
            truncated=state.truncated,
            discount=jnp.ones((), jnp.float32),
        )

    def _is(self, kind: str) -> jax.Array:
        return self.kind == KINDS.index(kind)

    def _reward(self, bit: jax.Array, time: jax.Array, action: jax.Array) -> jax.Array:
        named = action[0] == bit
        waited = jnp.all(action == 0)
        rewards = {
            "value": time == 0,
            "discount": time == 2,
            "policy": (time == 0) & jnp.all(action == jnp.array([2, 1])),
            "cue": (time == 0) & named,
            "credit": (time == 2) & (bit == 1),
            "memory": jnp.where(time == 1, jnp.where(waited, 0, -1), (time == 2) & named),
        }
        return jnp.stack([rewards[kind].astype(jnp.float32) for kind in KINDS])[self.kind]
