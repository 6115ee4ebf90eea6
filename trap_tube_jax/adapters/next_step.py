"""Batches of environments whose reset takes a step, as is Gymnasium's default."""

import jax
import jax.numpy as jnp

from trap_tube_jax.vector import VectorEnvironment, VectorState
from trap_tube_jax.wrappers import AutoResetTimeStep, auto_reset_timestep


class NextStepVectorEnvironment(VectorEnvironment):
    """A `VectorEnvironment` that starts the next episode in the step after the last.

    The reset step ignores its action, pays 0 and returns the new episode's first observation.
    """

    def step(self, state: VectorState, actions: jax.Array) -> tuple[VectorState, AutoResetTimeStep]:
        """Takes actions i32[B, 2], or starts the next episode where one has ended."""
        stepped, timestep, final_picture = self._advance(state, actions)
        was_done = state.episodes.inner.done
        state, picture = self._reset_done(was_done, stepped, final_picture)
        timestep = timestep.replace(
            terminated=timestep.terminated & ~was_done,
            truncated=timestep.truncated & ~was_done,
            discount=jnp.where(was_done, 1.0, timestep.discount),
        )
        return state, auto_reset_timestep(timestep, picture, final_picture)
