"""Intrinsic motivation: what the agent finds new, and how that is learned.

A curiosity is a flax module with two methods, both pure functions of arrays:
`encode`, its own features of an observation (of width 0 if it has none), and
`predict`, its prediction error and inverse model on a batch of transitions.

Source: agent specification "Network" and "ICM"; Pathak et al. (2017) for `icm`,
Burda et al. (2019a) for the detached encoder's rationale, Burda et al. (2019b) for `rnd`,
Tang et al. (2017) for `counts`.
"""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from agents.networks.core import dense, output_dense
from agents.networks.encoder import Encoder
from trap_tube_jax.objects import NUM_DIRECTIONS


class Transition(NamedTuple):
    """What a curiosity may look at; leading axes are free.

    Attributes:
      embedding: f32[..., H], the GRU's output h at the step.
      next_embedding: f32[..., H], h', the GRU's output after the step.
      action_embedding: f32[..., E], the policy's embedding of the action.
      features: f32[..., F], the curiosity's own features of the observation.
      next_features: f32[..., F], the same of the next observation.
      action: i32[..., 2], the (grasp, move) taken.
    """

    embedding: jax.Array
    next_embedding: jax.Array
    action_embedding: jax.Array
    features: jax.Array
    next_features: jax.Array
    action: jax.Array


class Prediction(NamedTuple):
    """What a curiosity says of a transition.

    Attributes:
      error: f32[..., U], squared errors of the prediction, unit by unit. Their sum is the
        intrinsic reward, their mean the forward loss.
      grasp_logits: f32[..., 4] of the inverse model, or None if there is none.
      move_logits: f32[..., 4], likewise.
    """

    error: jax.Array
    grasp_logits: jax.Array | None
    move_logits: jax.Array | None


class InverseModel(nn.Module):
    """Which action led from one embedding to the next: one hidden layer, two heads."""

    hidden: int

    @nn.compact
    def __call__(
        self, embedding: jax.Array, next_embedding: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Grasp and move logits, each f32[..., 4], from two f32[..., H]."""
        x = nn.swish(dense(self.hidden)(jnp.concatenate([embedding, next_embedding], axis=-1)))
        grasp = output_dense(NUM_DIRECTIONS, name="grasp")(x)
        return grasp, output_dense(NUM_DIRECTIONS, name="move")(x)


class ForwardModel(nn.Module):
    """The next embedding from this one and the action: h + dense([h, action])."""

    @nn.compact
    def __call__(self, embedding: jax.Array, action: jax.Array) -> jax.Array:
        """f32[..., H] and f32[..., E] to f32[..., H]."""
        x = jnp.concatenate([embedding, action], axis=-1)
        return embedding + output_dense(embedding.shape[-1])(x)


class ICM(nn.Module):
    """The paper's curiosity: forward and inverse models over the policy's own GRU outputs.

    Nothing is stopped: both losses shape the policy's encoder.
    """

    hidden: int

    def setup(self) -> None:
        """Declares the two models."""
        self.forward = ForwardModel()
        self.inverse = InverseModel(self.hidden)

    def encode(self, observation: jax.Array) -> jax.Array:
        """No features of its own: f32[M, 0] for u8[M, 12, 12, N]."""
        return jnp.zeros((len(observation), 0))

    def predict(self, transition: Transition) -> Prediction:
        """Errors of the forward model on h', and the inverse model's logits."""
        predicted = self.forward(transition.embedding, transition.action_embedding)
        inverse = self.inverse(transition.embedding, transition.next_embedding)
        return Prediction(jnp.square(predicted - transition.next_embedding), *inverse)


class DetachedICM(nn.Module):
    """ICM with an encoder of its own, trained by the inverse loss alone.

    The forward model sees its features but does not move them, so they cannot collapse
    to what is easily predicted, and the policy's encoder serves the policy only.
    """

    hidden: int
    filters: tuple[int, int]

    def setup(self) -> None:
        """Declares the encoder and the two models."""
        self.encoder = Encoder(self.filters)
        self.forward = ForwardModel()
        self.inverse = InverseModel(self.hidden)

    def encode(self, observation: jax.Array) -> jax.Array:
        """Its own features f32[M, filters[1]] of u8[M, 12, 12, N]."""
        return self.encoder(observation)

    def predict(self, transition: Transition) -> Prediction:
        """Errors of the forward model on the next features, and the inverse logits."""
        features = jax.lax.stop_gradient(transition.features)
        next_features = jax.lax.stop_gradient(transition.next_features)
        one_hot = jax.nn.one_hot(transition.action, NUM_DIRECTIONS)
        action = one_hot.reshape(*one_hot.shape[:-2], -1)
        predicted = self.forward(features, action)
        inverse = self.inverse(transition.features, transition.next_features)
        return Prediction(jnp.square(predicted - next_features), *inverse)


class RND(nn.Module):
    """Random network distillation: the error in imitating a fixed random encoder."""

    hidden: int
    filters: tuple[int, int]

    def setup(self) -> None:
        """Declares the fixed target and the predictor."""
        self.target = Encoder(self.filters)
        self.predictor = Encoder(self.filters)
        self.readout = nn.Sequential([dense(self.hidden), nn.swish, output_dense(self.filters[1])])

    def encode(self, observation: jax.Array) -> jax.Array:
        """Predictor and target side by side, f32[M, 2 * filters[1]]."""
        target = jax.lax.stop_gradient(self.target(observation))
        return jnp.concatenate([self.readout(self.predictor(observation)), target], axis=-1)

    def predict(self, transition: Transition) -> Prediction:
        """Errors on the next observation; there is no inverse model."""
        predicted, target = jnp.split(transition.next_features, 2, axis=-1)
        return Prediction(jnp.square(predicted - target), None, None)


def visit_bonus(visits: jax.Array, slot: jax.Array, mask: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The novelty of observations by how often training has seen them (Tang et al., 2017).

      n(o) <- n(o) + visits of o in this batch,  bonus = n(o)^(-1/2).

    Args:
      visits: f32[S], visits so far, by slot of a hash table.
      slot: i32[...], the slot of every observation.
      mask: f32[...], 1 where an observation counts.

    Returns:
      The bonus f32[...], 0 where masked out, and the new visits f32[S].
    """
    visits = visits.at[slot.reshape(-1)].add(mask.reshape(-1))
    return mask / jnp.sqrt(jnp.maximum(visits[slot], 1.0)), visits


def intrinsic_reward(prediction: Prediction) -> jax.Array:
    """The prediction error f32[...], summed over units."""
    return jnp.sum(prediction.error, axis=-1)


def forward_loss(prediction: Prediction) -> jax.Array:
    """The prediction error f32[...], averaged over units."""
    return jnp.mean(prediction.error, axis=-1)
