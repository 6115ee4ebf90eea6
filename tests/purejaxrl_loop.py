"""PPO in the structure of PureJaxRL: what that structure asks of an environment.

Everything is one `train(key)`: wrappers that hold the environment and forward what they
do not know, `jax.vmap(env.reset, in_axes=(0, None))`, a scan over updates around a scan
over steps, `info` stacked over both. The learning itself is the shortest that works.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from flax import struct


class Wrapper:
    def __init__(self, env):
        self._env = env

    def __getattr__(self, name):
        return getattr(self._env, name)


class FlattenObservation(Wrapper):
    @functools.partial(jax.jit, static_argnums=0)
    def reset(self, key, params=None):
        observation, state = self._env.reset(key, params)
        return observation.reshape(-1), state

    @functools.partial(jax.jit, static_argnums=0)
    def step(self, key, state, action, params=None):
        observation, *rest = self._env.step(key, state, action, params)
        return observation.reshape(-1), *rest


@struct.dataclass
class LogState:
    env_state: Any
    running_return: float
    running_length: int
    last_return: float
    last_length: int


class Log(Wrapper):
    @functools.partial(jax.jit, static_argnums=0)
    def reset(self, key, params=None):
        observation, state = self._env.reset(key, params)
        return observation, LogState(state, 0.0, 0, 0.0, 0)

    @functools.partial(jax.jit, static_argnums=0)
    def step(self, key, state, action, params=None):
        observation, env_state, reward, done, info = self._env.step(
            key, state.env_state, action, params
        )
        total, length = state.running_return + reward, state.running_length + 1
        state = LogState(
            env_state=env_state,
            running_return=total * (1 - done),
            running_length=length * (1 - done),
            last_return=state.last_return * (1 - done) + total * done,
            last_length=state.last_length * (1 - done) + length * done,
        )
        info["returned_episode_returns"] = state.last_return
        info["returned_episode_lengths"] = state.last_length
        info["returned_episode"] = done
        return observation, state, reward, done, info


class Vectorize(Wrapper):
    def __init__(self, env):
        super().__init__(env)
        self.reset = jax.vmap(env.reset, in_axes=(0, None))
        self.step = jax.vmap(env.step, in_axes=(0, 0, 0, None))


@struct.dataclass
class NormalizeState:
    mean: jax.Array
    var: jax.Array
    count: jax.Array
    env_state: Any


class NormalizeObservation(Wrapper):
    def reset(self, key, params=None):
        observation, env_state = self._env.reset(key, params)
        zeros = jnp.zeros(observation.shape[1:])
        state = NormalizeState(zeros, zeros + 1, jnp.float32(1e-4), env_state)
        return self._normalize(state, observation)

    def step(self, key, state, action, params=None):
        observation, env_state, *rest = self._env.step(key, state.env_state, action, params)
        normalized, state = self._normalize(state.replace(env_state=env_state), observation)
        return normalized, state, *rest

    def _normalize(self, state, observation):
        batch, count = len(observation), state.count + len(observation)
        delta = observation.mean(0) - state.mean
        mean = state.mean + delta * batch / count
        spread = state.var * state.count + observation.var(0) * batch
        var = (spread + delta**2 * state.count * batch / count) / count
        state = state.replace(mean=mean, var=var, count=count)
        return (observation - mean) / jnp.sqrt(var + 1e-8), state


class ActorCritic(nn.Module):
    num_actions: int

    @nn.compact
    def __call__(self, x):
        hidden = nn.tanh(nn.Dense(64)(x))
        return nn.Dense(self.num_actions)(hidden), nn.Dense(1)(hidden)[..., 0]


def make_train(env, params, *, num_envs=32, num_steps=16, num_updates=24, learning_rate=3e-3):
    env = NormalizeObservation(Vectorize(Log(FlattenObservation(env))))
    network = ActorCritic(env.action_space(params).n)
    optimizer = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(learning_rate, eps=1e-5))

    def act(carry, _):
        weights, env_state, observation, key = carry
        key, action_key, step_key = jax.random.split(key, 3)
        logits, value = network.apply(weights, observation)
        action = jax.random.categorical(action_key, logits)
        step_keys = jax.random.split(step_key, num_envs)
        following, env_state, reward, done, info = env.step(step_keys, env_state, action, params)
        log_prob = jnp.take_along_axis(nn.log_softmax(logits), action[:, None], 1)[:, 0]
        seen = (observation, action, log_prob, value, reward, done)
        return (weights, env_state, following, key), (seen, info)

    def loss(weights, seen, returns):
        observation, action, old_log_prob, old_value, _, _ = seen
        logits, value = network.apply(weights, observation)
        log_probs = nn.log_softmax(logits)
        ratio = jnp.exp(
            jnp.take_along_axis(log_probs, action[..., None], -1)[..., 0] - old_log_prob
        )
        advantage = returns - old_value
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        surrogate = jnp.minimum(ratio * advantage, jnp.clip(ratio, 0.8, 1.2) * advantage)
        entropy = -jnp.sum(jnp.exp(log_probs) * log_probs, -1)
        return jnp.mean(0.5 * (value - returns) ** 2 - surrogate - 0.01 * entropy)

    def update(carry, _):
        weights, moments, *env_carry = carry
        (_, *env_carry), (seen, info) = jax.lax.scan(act, (weights, *env_carry), None, num_steps)
        _, last_value = network.apply(weights, env_carry[1])

        def discount(following, step):
            reward, done = step
            return (value := reward + 0.99 * (1 - done) * following), value

        _, returns = jax.lax.scan(discount, last_value, seen[-2:], reverse=True)

        def epoch(carry, _):
            weights, moments = carry
            updates, moments = optimizer.update(jax.grad(loss)(weights, seen, returns), moments)
            return (optax.apply_updates(weights, updates), moments), None

        (weights, moments), _ = jax.lax.scan(epoch, (weights, moments), None, 4)
        return (weights, moments, *env_carry), info

    def train(key):
        network_key, reset_key, key = jax.random.split(key, 3)
        observation, env_state = env.reset(jax.random.split(reset_key, num_envs), params)
        weights = network.init(network_key, observation)
        carry = (weights, optimizer.init(weights), env_state, observation, key)
        return jax.lax.scan(update, carry, None, num_updates)[1]

    return train
