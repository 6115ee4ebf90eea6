"""Recurrent PPO with an intrinsic curiosity module in one file, to read from top to bottom.

Computes network, rewards and losses of preset `paper` in the plainest way:

    python -m agents.examples.plain_ppo

`python -m benchmarks.learner_peers` compares its speed with `agents.ppo`'s.

An episode has T steps, and step t leads from observation t to observation t + 1. B episodes are an
iteration. The GRU has H units. Source: Schulman et al. (2017); Pathak et al. (2017); agent.md.
"""

import argparse
import functools
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from flax.training import train_state

import trap_tube_jax as tt
from agents import Config
from agents.examples.near_food import NEAR_FOOD

Batch = tuple["Episode", jax.Array, jax.Array]  # [B, ...]; advantage and value target f32[B, T]
he_normal = nn.initializers.he_normal()
dense = functools.partial(nn.Dense, kernel_init=he_normal)
conv = functools.partial(nn.Conv, kernel_init=he_normal)


class Episode(NamedTuple):
    """An episode, played under the parameters before the update."""

    observation: jax.Array  # u8[T + 1, 12, 12, N]
    action: jax.Array  # i32[T, 2], grasp and move
    reward: jax.Array  # f32[T], extrinsic
    mask: jax.Array  # f32[T], 1 until the episode ends, 0 afterwards
    log_prob: jax.Array  # f32[T], of the action
    value: jax.Array  # f32[T]


class TrainState(train_state.TrainState):
    """Parameters and the optimizer's state, moving averages and a PRNG key."""

    variance: jax.Array  # f32[2], of extrinsic and intrinsic reward
    key: jax.Array


class Encoder(nn.Module):
    """The paper's encoder: u8[..., 12, 12, N] to f32[..., filters[1]]."""

    filters: tuple[int, int]

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        """Convolves the features, scaled to [-1, 1], and the coordinates of each cell."""
        row, column = jnp.indices(observation.shape[-3:-1]) / (observation.shape[-2] - 1)
        coordinates = 2 * jnp.stack([column, row, jnp.hypot(row, column) / 2**0.5], axis=-1) - 1
        coordinates = jnp.broadcast_to(coordinates, (*observation.shape[:-1], 3))
        x = jnp.concatenate([observation / 127.5 - 1, coordinates], axis=-1)
        for features in self.filters:
            x = nn.swish(conv(features, (2, 2))(x))
        for _ in range(2):
            x = nn.max_pool(x, (2, 2), strides=(2, 2))
            y = conv(x.shape[-1], (3, 3))(nn.swish(x))
            x = x + conv(x.shape[-1], (3, 3))(nn.swish(y))
        return jnp.max(x, axis=(-3, -2))


class Network(nn.Module):
    """Policy, value, and the forward and inverse model of the curiosity, over encoder and GRU."""

    encoder: nn.Module
    hidden: int
    embedding: int

    def setup(self) -> None:
        """Declares the layers."""
        embed = functools.partial(nn.Embed, 4, self.embedding, embedding_init=he_normal)
        self.grasp = embed()
        self.move = embed()
        self.reward = dense(self.embedding)
        self.initial = self.param("initial", nn.initializers.zeros, (self.hidden,))
        self.gru = nn.GRUCell(self.hidden, kernel_init=he_normal, recurrent_kernel_init=he_normal)
        self.unroll: Any = nn.RNN(self.gru)
        self.policy = nn.DenseGeneral((2, 4))
        self.critic = nn.Dense(1)
        self.mix = dense(self.hidden)
        self.forward = nn.Dense(self.hidden)
        self.inverse = nn.Sequential([dense(self.hidden), nn.swish, nn.DenseGeneral((2, 4))])

    def embed(self, action: jax.Array) -> jax.Array:
        """Returns the embeddings of grasp and move, concatenated."""
        return jnp.concatenate([self.grasp(action[..., 0]), self.move(action[..., 1])], axis=-1)

    def inputs(self, observation: jax.Array, action: jax.Array, reward: jax.Array) -> jax.Array:
        """Returns the GRU's input f32[..., H]; action and reward of the step before."""
        parts = [self.encoder(observation), self.embed(action), nn.swish(self.reward(reward))]
        return nn.swish(self.mix(jnp.concatenate(parts, axis=-1)))

    def act(self, state: jax.Array, *inputs: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Advances the GRU by one step; returns its state f32[H], logits f32[2, 4] and value."""
        state, output = self.gru(state, self.inputs(*inputs))
        return state, self.policy(output), self.critic(output)[..., 0]

    def __call__(self, episode: Episode) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """Returns the policy's logits, value, forward error f32[T, H] and the inverse logits."""
        action = jnp.pad(episode.action, ((1, 0), (0, 0)))
        reward = jnp.pad(episode.reward, (1, 0))[:, None]
        inputs = self.inputs(episode.observation, action, reward)
        both = jnp.stack([inputs[:-1], inputs[1:]])
        here, later = self.unroll(both, initial_carry=jnp.stack([self.initial] * 2))
        predicted = here + self.forward(jnp.concatenate([here, self.embed(episode.action)], -1))
        inferred = self.inverse(jnp.concatenate([here, later], -1))
        return self.policy(here), self.critic(here)[..., 0], (predicted - later) ** 2, inferred


def log_prob(logits: jax.Array, action: jax.Array) -> jax.Array:
    """Returns log p(grasp) + log p(move), f32[...]."""
    return -optax.softmax_cross_entropy_with_integer_labels(logits, action).sum(axis=-1)


def discounted_sum(x: jax.Array, discount: float) -> jax.Array:
    """Returns y_t = x_t + discount * y_{t+1} for x f32[B, T], from the last step backwards."""

    def add(y: jax.Array, x_t: jax.Array) -> tuple[jax.Array, jax.Array]:
        y = x_t + discount * y
        return y, y

    return jax.lax.scan(add, jnp.zeros_like(x[:, 0]), x.T, reverse=True)[1].T


class PlainPPO:
    """Training as pure functions; an iteration is `collect`, then an `update` per minibatch."""

    def __init__(self, config: Config, env: Any = None, encoder: nn.Module | None = None):
        sizes = {"num_features": config.num_features, "max_steps": config.max_steps}
        self.config = config
        self.env = env or tt.make(config.env_id, **sizes)
        encoder = encoder or Encoder(config.filters)
        self.network: Any = Network(encoder, config.hidden, config.embedding)
        self.apply = jax.vmap(self.network.apply, (None, 0))  # to episodes [B, ...]

    def init(self, key: jax.Array) -> TrainState:
        """Draws the parameters."""
        params_key, key = jax.random.split(key)
        observation = jnp.zeros((2, *self.env.observation_spec.shape), jnp.uint8)
        episode = Episode(observation, jnp.zeros((1, 2), jnp.int32), *jnp.zeros((4, 1)))
        adam = optax.adam(self.config.learning_rate, eps=self.config.adam_epsilon)
        return TrainState.create(
            apply_fn=self.network.apply,
            params=self.network.init(params_key, episode),
            tx=optax.chain(optax.clip_by_global_norm(self.config.max_gradient_norm), adam),
            variance=jnp.zeros(2),
            key=key,
        )

    def collect(self, state: TrainState) -> tuple[TrainState, Batch, jax.Array]:
        """Plays the episodes of an iteration, and draws its minibatches i32[updates, size]."""
        play_key, order_key, key = jax.random.split(state.key, 3)
        count = self.config.episodes_per_iteration
        epochs = self.config.epochs
        episode = jax.vmap(self.play, (None, 0))(state.params, jax.random.split(play_key, count))
        variance, batch = self.prepare(state, episode)
        orders = [jax.random.permutation(k, count) for k in jax.random.split(order_key, epochs)]
        minibatches = jnp.concatenate(orders).reshape(-1, self.config.minibatch_size)
        return state.replace(variance=variance, key=key), batch, minibatches

    def play(self, params: Any, key: jax.Array) -> Episode:
        """Plays an episode."""
        reset_key, key = jax.random.split(key)
        state, timestep = self.env.reset(reset_key)

        def step(carry: Any, time: jax.Array) -> Any:
            state, mask, inputs = carry
            hidden, logits, value = self.network.apply(params, *inputs, method="act")
            drawn = jax.random.categorical(jax.random.fold_in(key, time), logits)
            action = drawn.astype(jnp.int32)
            state, timestep = self.env.step(state, action)
            reward = mask * timestep.reward
            record = (inputs[1], action, reward, mask, log_prob(logits, action), value)
            inputs = (hidden, timestep.observation, action, reward[None])
            return (state, mask * (1.0 - timestep.done), inputs), record

        start = params["params"]["initial"]
        nothing = (jnp.zeros(2, jnp.int32), jnp.zeros(1))
        first = (state, jnp.ones(()), (start, timestep.observation, *nothing))
        times = jnp.arange(self.env.max_steps)
        (_, _, inputs), record = jax.lax.scan(step, first, times)
        return Episode(jnp.concatenate([record[0], inputs[1][None]]), *record[1:])

    def prepare(self, state: TrainState, episode: Episode) -> tuple[jax.Array, Batch]:
        """Adds both rewards, estimates advantages; returns the rewards' variances and a batch."""
        config = self.config
        mask = episode.mask
        error = self.apply(state.params, episode)[2]
        rewards = jnp.stack([episode.reward, mask * jnp.sum(error, axis=-1)])
        keep = jnp.where(state.step > 0, config.reward_ema_decay, 0.0)
        fresh = jnp.var(rewards, axis=(1, 2), where=mask > 0)
        variance = keep * state.variance + (1 - keep) * fresh
        scale = jnp.array([1, config.intrinsic_coef]) / jnp.where(variance > 0, variance, 1) ** 0.5
        reward = jnp.tensordot(scale, rewards, axes=1)
        # As in the published baseline, the last step bootstraps from its own value.
        following = jnp.concatenate([episode.value[:, 1:], episode.value[:, -1:]], axis=1)
        delta = mask * (reward + config.discount * following - episode.value)
        advantage = discounted_sum(delta, config.discount * config.gae_lambda)
        advantage = mask * jax.nn.standardize(advantage, (0, 1), epsilon=1e-8, where=mask > 0)
        return variance, (episode, advantage, discounted_sum(reward, config.discount))

    def update(self, state: TrainState, batch: Batch, index: jax.Array) -> tuple[TrainState, Any]:
        """Takes a gradient step on the episodes of `index`; returns the terms of the loss, too."""
        minibatch = jax.tree.map(lambda x: x[index], batch)
        gradient, terms = jax.grad(self.loss, has_aux=True)(state.params, minibatch)
        return state.apply_gradients(grads=gradient), terms

    def loss(self, params: Any, batch: Batch) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Returns the loss f32[] and its terms, in whose means padding counts as zeros."""
        config = self.config
        episode, advantage, target = batch
        logits, value, error, inferred = self.apply(params, episode)
        entropy = optax.softmax_cross_entropy(logits, jax.nn.softmax(logits)).sum(axis=-1)
        ratio = jnp.exp(log_prob(logits, episode.action) - episode.log_prob)
        clipped = jnp.clip(ratio, 1 - config.clip_eps, 1 + config.clip_eps)
        terms = {
            "policy_loss": -jnp.minimum(ratio * advantage, clipped * advantage),
            "value_loss": config.value_coef * jnp.square(value - target),
            "entropy_loss": -config.entropy_coef * entropy,
            "forward_loss": config.curiosity_coef * jnp.mean(error, axis=-1),
            "inverse_loss": -config.curiosity_coef * log_prob(inferred, episode.action),
        }
        terms = {name: jnp.mean(episode.mask * term) for name, term in terms.items()}
        return sum(terms.values(), jnp.zeros(())), terms


def main(env: str = NEAR_FOOD.short, iterations: int = 10) -> float:
    """Trains on a small scale; returns the fraction of the last episodes that were solved."""
    small = {"episodes_per_iteration": 64, "minibatch_size": 16, "epochs": 5}
    learner = PlainPPO(Config.preset("paper", env_id=env, **small))
    collect = jax.jit(learner.collect)
    update = jax.jit(learner.update)
    state = learner.init(jax.random.key(0))
    success = 0.0
    for iteration in range(1, iterations + 1):
        state, batch, minibatches = collect(state)
        for index in minibatches:
            state, _ = update(state, batch, index)
        success = float(batch[0].reward.sum(axis=1).mean())
        print(f"iteration {iteration}: {success:.0%} of the episodes solved")
    return success


if __name__ == "__main__":
    argparse.ArgumentParser(
        "python -m agents.examples.plain_ppo",
        description="Trains recurrent PPO with ICM, in one file, on a task of two steps.",
    ).parse_args()
    main()
