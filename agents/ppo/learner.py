"""PPO with curiosity: one iteration of training as one pure function.

Source: agent specification "PPO" and "ICM"; paper section "Results".
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

import trap_tube_jax as tt
from agents.acting.observations import (
    VISIT_SLOTS,
    encode_episodes,
    first_visits,
    observation_ids,
    visit_slots,
)
from agents.acting.rollout import Trajectory, action_log_prob, rollout, sample_action
from agents.config import Config
from agents.curiosity.modules import Prediction, forward_loss, intrinsic_reward, visit_bonus
from agents.networks.agent import Agent, Params
from agents.parallel.sharding import ALONE, Shards
from agents.ppo import losses, returns
from agents.ppo.method import Metrics, Train, environment
from agents.ppo.optimizer import cooldown, make_optimizer
from agents.ppo.replay import Replay
from trap_tube_jax.environment import Environment

# Over [T, B] arrays.
discounted_returns = jax.vmap(returns.discounted_returns, in_axes=(1, None), out_axes=1)
generalized_advantages = jax.vmap(
    returns.generalized_advantages, in_axes=(1, 1, 0, 1, None, None), out_axes=1
)


class TrainState(NamedTuple):
    """Everything that training carries from one iteration to the next.

    Attributes:
      params: the network's parameters.
      opt_state: the optimiser's state.
      extrinsic: moments of the extrinsic reward.
      intrinsic: moments of the intrinsic reward.
      visits: f32[S], how often observations were seen, by slot of a hash table; one unused
        slot without the curiosity `counts`.
      replay: the newest solved episodes; never filled without imitation.
      key: PRNG key of all iterations to come.
      iteration: i32[], iterations done.
      episodes: i32[], episodes played.
      transitions: i32[], environment steps taken.
    """

    params: Params
    opt_state: Any
    extrinsic: returns.Moments
    intrinsic: returns.Moments
    visits: jax.Array
    replay: Replay
    key: jax.Array
    iteration: jax.Array
    episodes: jax.Array
    transitions: jax.Array


class Batch(NamedTuple):
    """What one gradient step sees of its episodes, [T, B, ...] each.

    Attributes:
      observation_id: i32[T + 1, B], equal only for equal observations.
      layout: B states; `cells`: u8[T + 1, B, 3, 2]; together the observations.
      cells: see `layout`.
      action: i32[T, B, 2].
      reward: f32[T, B], extrinsic, as the network sees it.
      mask: f32[T, B].
      log_prob: f32[T, B], under the acting parameters.
      advantage: f32[T, B].
      value_target: f32[T, B].
    """

    observation_id: jax.Array
    layout: tt.State
    cells: jax.Array
    action: jax.Array
    reward: jax.Array
    mask: jax.Array
    log_prob: jax.Array
    advantage: jax.Array
    value_target: jax.Array

    def take(self, episodes: jax.Array) -> "Batch":
        """The batch of these episodes, i32[M]."""
        rest = self._replace(layout=None)
        taken = jax.tree.map(lambda x: x[:, episodes], rest)
        return taken._replace(layout=jax.tree.map(lambda x: x[episodes], self.layout))


def make_train(config: Config, env: Environment | None = None, shards: Shards = ALONE) -> Train:
    """Builds training from its settings.

    Args:
      config: the settings.
      env: an environment of your own; that of `config.env_id` if absent.
      shards: how to divide the episodes; more than one only within `Placement.shard`.

    Raises:
      ValueError: `env` contradicts `config`.
    """
    env = environment(config, env)
    agent = Agent(config)
    optimizer = make_optimizer(config)

    def init(key: jax.Array) -> TrainState:
        params_key, key = jax.random.split(key)
        params = agent.init(params_key)
        zero = jnp.zeros((), jnp.int32)
        return TrainState(
            params=params,
            opt_state=optimizer.init(params),
            extrinsic=returns.Moments.zero(),
            intrinsic=returns.Moments.zero(),
            visits=jnp.zeros(VISIT_SLOTS if config.curiosity == "counts" else 1),
            replay=Replay.empty(env.base, config.imitation_episodes, config.max_steps),
            key=key,
            iteration=zero,
            episodes=zero,
            transitions=zero,
        )

    def iterate(state: TrainState) -> tuple[TrainState, Metrics]:
        reset_key, action_key, update_key, key = jax.random.split(state.key, 4)
        reset_keys = shards.part(jax.random.split(reset_key, config.episodes))
        initial, _ = jax.vmap(env.reset)(reset_keys)
        trajectory = rollout(
            agent,
            state.params,
            env,
            initial,
            action_key,
            choose=shards.drawing(sample_action),
            chunk=config.chunk,
        )
        batch, state, play_metrics = prepare(agent, config, state, trajectory, shards)
        params, opt_state, loss_metrics = optimize(
            agent, config, optimizer, state, batch, update_key, shards
        )
        state = state._replace(
            params=params,
            opt_state=opt_state,
            key=key,
            iteration=state.iteration + 1,
            episodes=state.episodes + config.episodes,
        )
        return state, {**play_metrics, **loss_metrics}

    return Train(init, iterate, agent, env, config, shards)


def prepare(
    agent: Agent,
    config: Config,
    state: TrainState,
    trajectory: Trajectory,
    shards: Shards = ALONE,
) -> tuple[Batch, TrainState, Metrics]:
    """Turns episodes into what the gradient steps learn from, under the acting parameters.

    Args:
      agent: the network.
      config: the settings.
      state: the state of training.
      trajectory: this device's episodes.
      shards: how the episodes are divided over devices.

    Returns:
      The batch of all devices' episodes, the state with the rewards' moments, the visits, the
      replay and the transitions brought up to date, and metrics of play.
    """
    error = None
    if agent.curiosity is not None:
        error = shards.whole(_curiosity_reward(agent, state.params, trajectory), axis=1)
    trajectory = trajectory.gathered(shards)
    mask = trajectory.mask
    observation_id = observation_ids(trajectory.layout, trajectory.cells)
    extrinsic = state.extrinsic.update(trajectory.reward, mask, config.reward_rate)
    reward = trajectory.reward / extrinsic.deviation
    curiosity, intrinsic, visits = jnp.zeros_like(mask), state.intrinsic, state.visits
    if config.curiosity != "none":
        if error is None:
            curiosity, visits = visit_bonus(visits, visit_slots(trajectory)[1:], mask)
        else:
            curiosity = mask * error
        if config.episodic_novelty:
            curiosity = curiosity * first_visits(observation_id)[1:]
        intrinsic = intrinsic.update(curiosity, mask, config.reward_rate)
        reward = reward + config.intrinsic_scale * curiosity / intrinsic.deviation

    discount, lambda_ = jnp.float32(config.discount), jnp.float32(config.gae_lambda)
    advantage = generalized_advantages(
        reward, trajectory.value, trajectory.value[-1], mask, discount, lambda_
    )
    batch = Batch(
        observation_id=observation_id,
        layout=trajectory.layout,
        cells=trajectory.cells,
        action=trajectory.action,
        reward=trajectory.reward,
        mask=mask,
        log_prob=trajectory.log_prob,
        advantage=returns.normalize(advantage, mask),
        value_target=discounted_returns(reward, discount),
    )
    metrics = {
        "success": jnp.mean(trajectory.solved.astype(jnp.float32)),
        "episode_length": jnp.mean(trajectory.length.astype(jnp.float32)),
        "intrinsic_reward": jnp.sum(curiosity) / jnp.sum(mask),
        "distinct_observations": jnp.max(observation_id) + 1,
    }
    if config.imitation_coef:
        state = state._replace(replay=state.replay.remember(trajectory))
    transitions = state.transitions + jnp.sum(trajectory.length)
    state = state._replace(
        extrinsic=extrinsic, intrinsic=intrinsic, visits=visits, transitions=transitions
    )
    return batch, state, metrics


def optimize(
    agent: Agent,
    config: Config,
    optimizer: optax.GradientTransformation,
    state: TrainState,
    batch: Batch,
    key: jax.Array,
    shards: Shards = ALONE,
) -> tuple[Params, Any, Metrics]:
    """All epochs of gradient steps on minibatches of whole episodes, shuffled anew in each.

    Every device differentiates its part of each minibatch; the mean is everyone's gradient.
    """

    def update(
        carry: tuple[Params, Any], episodes: jax.Array
    ) -> tuple[tuple[Params, Any], Metrics]:
        params, opt_state = carry
        own = batch.take(shards.part(episodes))
        gradient, metrics = shards.mean(
            jax.grad(loss, has_aux=True)(params, agent, config, own, state.replay, shards)
        )
        updates, opt_state = optimizer.update(gradient, opt_state, params)
        updates = jax.tree.map(lambda update: rate * update, updates)
        metrics["gradient_norm"] = optax.tree.norm(gradient)
        metrics["entropy"] /= metrics.pop("steps")
        params: Any = optax.apply_updates(params, updates)
        return (params, opt_state), metrics

    def permute(epoch_key: jax.Array) -> jax.Array:
        order = jax.random.permutation(epoch_key, config.episodes)
        return order.reshape(-1, config.minibatch)

    rate = cooldown(config, state.iteration)
    minibatches = jax.vmap(permute)(jax.random.split(key, config.epochs))
    (params, opt_state), metrics = jax.lax.scan(
        update, (state.params, state.opt_state), minibatches.reshape(-1, config.minibatch)
    )
    return params, opt_state, jax.tree.map(jnp.mean, metrics)


def loss(
    params: Params,
    agent: Agent,
    config: Config,
    batch: Batch,
    replay: Replay,
    shards: Shards = ALONE,
) -> tuple[jax.Array, Metrics]:
    """The total loss f32[] and its terms, weighted as they enter it; both as means over devices.

    L = policy + value - entropy + curiosity_coef * (forward + inverse) + imitation

    Beside the terms: the sums of the entropy over `steps`, and of those.
    """
    features = encode_episodes(
        params, agent, config, batch.observation_id, batch.layout, batch.cells
    )
    curiosity_terms: Metrics = {}
    if agent.curiosity is None:
        embedding = agent.unroll(params, features, batch.action, batch.reward)
    else:
        embedding, following = agent.unroll_both(params, features, batch.action, batch.reward)
        prediction = agent.predict(params, embedding, following, features, batch.action)
        curiosity_terms = curiosity_losses(config, prediction, batch)
    outputs = agent.act(params, embedding)
    log_prob = action_log_prob(outputs, batch.action)
    surrogate = losses.clipped_surrogate(log_prob, batch.log_prob, batch.advantage, config.clip)
    value_error = losses.squared_error(outputs.value, batch.value_target)
    entropy = losses.entropy(outputs.grasp_logits) + losses.entropy(outputs.move_logits)
    terms = {
        "policy_loss": losses.masked_mean(surrogate, batch.mask),
        "value_loss": config.value_coef * losses.masked_mean(value_error, batch.mask),
        "entropy_loss": -config.entropy_coef * losses.masked_mean(entropy, batch.mask),
    }
    terms |= curiosity_terms
    if config.imitation_coef:
        terms["imitation_loss"] = imitation_loss(params, agent, config, replay, shards)
    total = sum(terms.values(), jnp.zeros(()))
    sums = {"entropy": jnp.sum(entropy * batch.mask), "steps": jnp.sum(batch.mask)}
    return total, {**terms, "loss": total, **sums}


def curiosity_losses(config: Config, prediction: Prediction, batch: Batch) -> Metrics:
    """The forward loss and, where there is an inverse model, the inverse loss, weighted."""
    coef = config.curiosity_coef
    terms = {"forward_loss": coef * losses.masked_mean(forward_loss(prediction), batch.mask)}
    if prediction.grasp_logits is not None and prediction.move_logits is not None:
        grasp = losses.log_prob(prediction.grasp_logits, batch.action[..., 0])
        move = losses.log_prob(prediction.move_logits, batch.action[..., 1])
        terms["inverse_loss"] = -coef * losses.masked_mean(grasp + move, batch.mask)
    return terms


def imitation_loss(
    params: Params, agent: Agent, config: Config, replay: Replay, shards: Shards = ALONE
) -> jax.Array:
    """Minus the log-likelihood of remembered successes, each step weighted by its return.

      imitation_coef * mean over steps of -G_t log pi(a_t | o_t)

    Returns:
      f32[], this device's share, of which the mean over devices is the loss; 0 while nothing
      is remembered.
    """
    steps = jnp.maximum(jnp.sum(replay.mask), 1.0) / shards.count
    if shards.count > 1:
        place, is_own = shards.places(replay.mask.shape[1])
        replay = replay.take(place)
        replay = replay._replace(mask=replay.mask * is_own[None])
    observation_id = observation_ids(replay.layout, replay.cells)
    features = encode_episodes(params, agent, config, observation_id, replay.layout, replay.cells)
    embedding = agent.unroll(params, features, replay.action, replay.reward)
    log_prob = action_log_prob(agent.act(params, embedding), replay.action)
    weight = discounted_returns(replay.reward, jnp.float32(config.discount)) * replay.mask
    return -config.imitation_coef * jnp.sum(weight * log_prob) / steps


def _curiosity_reward(agent: Agent, params: Params, trajectory: Trajectory) -> jax.Array:
    """The raw intrinsic reward f32[T, B]."""
    _, next_embedding = agent.unroll_both(
        params, trajectory.features, trajectory.action, trajectory.reward
    )
    prediction = agent.predict(
        params, trajectory.embedding, next_embedding, trajectory.features, trajectory.action
    )
    return intrinsic_reward(prediction)
