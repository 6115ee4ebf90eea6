"""PPO with curiosity: one iteration of training as one pure function.

Source: agent specification "PPO" and "ICM"; paper section "Results".
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

import trap_tube_jax as tt
from agents import distinct, losses, returns
from agents.agent import Agent, Params
from agents.config import Config
from agents.curiosity import Prediction, forward_loss, intrinsic_reward, visit_bonus
from agents.optimizer import adam
from agents.replay import Replay
from agents.rollout import Trajectory, action_log_prob, place, rollout, sample_action
from agents.sharding import ALONE, Shards
from agents.starts import FRESH, Successes, explore, walk_environments
from trap_tube_jax.environment import Environment

Metrics = dict[str, jax.Array]

VISIT_SLOTS = 2**20

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
      successes: where restarts begin; never filled without them.
      key: PRNG key of all iterations to come.
      iteration: i32[], iterations done.
      episodes: i32[], episodes played.
      transitions: i32[], environment steps taken with the network.
      steps_walked: f32[], environment steps of random walks.
    """

    params: Params
    opt_state: Any
    extrinsic: returns.Moments
    intrinsic: returns.Moments
    visits: jax.Array
    replay: Replay
    successes: Successes
    key: jax.Array
    iteration: jax.Array
    episodes: jax.Array
    transitions: jax.Array
    steps_walked: jax.Array


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


class Train(NamedTuple):
    """Training as two pure functions; jit them, and vmap them over seeds.

    Attributes:
      init: PRNG key to the first `TrainState`.
      iterate: a `TrainState` to the next one and its metrics, f32[] each.
      agent: the network's functions.
      env: the environment.
      config: the settings.
      shards: how `iterate` divides its episodes over devices.
    """

    init: Callable[[jax.Array], TrainState]
    iterate: Callable[[TrainState], tuple[TrainState, Metrics]]
    agent: Agent
    env: Environment
    config: Config
    shards: Shards


def make_train(config: Config, env: Environment | None = None, shards: Shards = ALONE) -> Train:
    """Builds training from its settings.

    Args:
      config: the settings.
      env: an environment of your own; that of `config.env_id` if absent.
      shards: how to divide the episodes; more than one only within `Placement.shard`.

    Raises:
      ValueError: `env` contradicts `config`.
    """
    env = _environment(config, env)
    agent = Agent(config)
    optimizer = make_optimizer(config)
    walk_envs = walk_environments(config)

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
            successes=Successes.empty(config, env.base),
            key=key,
            iteration=zero,
            episodes=zero,
            transitions=zero,
            steps_walked=jnp.zeros(()),
        )

    def iterate(state: TrainState) -> tuple[TrainState, Metrics]:
        reset_key, action_key, update_key, key = jax.random.split(state.key, 4)
        reset_keys = shards.part(jax.random.split(reset_key, config.episodes))
        initial, _ = jax.vmap(env.reset)(reset_keys)
        origin = jnp.full(config.episodes, FRESH)
        if config.restarts:
            walk_key, choice_key = jax.random.split(jax.random.fold_in(reset_key, 0))
            successes, steps_walked = explore(walk_key, walk_envs, state.successes)
            state = state._replace(
                successes=successes, steps_walked=state.steps_walked + steps_walked
            )
            origin = successes.choose(choice_key, config)
            initial = successes.place(shards.part(origin), initial, config.max_steps)
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
        if config.restarts:
            solved = jnp.any(batch.reward > 0, axis=0)
            play_metrics |= start_metrics(state.successes, origin, solved)
            state = state._replace(successes=state.successes.rehearsed(origin, solved))
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


def make_optimizer(config: Config) -> optax.GradientTransformation:
    """Adam behind a clip of the gradients' global norm."""
    return optax.chain(
        optax.clip_by_global_norm(config.max_gradient_norm),
        adam(config.learning_rate, epsilon=config.adam_epsilon),
    )


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


def cooldown(config: Config, iteration: jax.Array) -> jax.Array:
    """f32[]: the factor of the step size, 1 until the last iterations and 0 after them."""
    if not config.cooldown:
        return jnp.ones(())
    left = (config.iterations - iteration) / (config.cooldown * config.iterations)
    return jnp.clip(left, 0.0, 1.0)


def start_metrics(successes: Successes, origin: jax.Array, solved: jax.Array) -> Metrics:
    """How the agent does at fresh tasks, and how far it has come in rehearsing successes."""
    is_fresh = origin == FRESH
    return {
        "fresh_success": jnp.sum(solved & is_fresh) / jnp.maximum(jnp.sum(is_fresh), 1),
        "rehearsed": successes.number,
        "reach": successes.mean_reach,
    }


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


def encode_episodes(
    params: Params,
    agent: Agent,
    config: Config,
    observation_id: jax.Array,
    layout: tt.State,
    cells: jax.Array,
) -> jax.Array:
    """The features f32[T + 1, B, F] of episodes, each distinct observation encoded once.

    Args:
      params: the parameters.
      agent: the network.
      config: the settings.
      observation_id: i32[T + 1, B], equal only for equal observations.
      layout: B states.
      cells: u8[T + 1, B, 3, 2]; with the layouts, the observations.
    """
    shape = observation_id.shape
    groups = distinct.group(observation_id.reshape(-1))
    time, episode = groups.representative // shape[1], groups.representative % shape[1]
    rows = jax.vmap(lambda layout, cells: tt.observe(place(layout, cells)))(
        jax.tree.map(lambda x: x[episode], layout), cells[time, episode]
    )
    features = distinct.map_rows(
        agent.encode, config.chunk, agent.encoding_params(params), rows, groups.total
    )
    return features[groups.number].reshape(*shape, -1)


def observation_ids(layout: tt.State, cells: jax.Array) -> jax.Array:
    """i32[T + 1, B]: equal only for equal observations, numbered from 0."""
    position = _position_ids(layout, cells)
    layout_id = jnp.broadcast_to(distinct.layout_ids(layout), position.shape)
    groups = distinct.group(layout_id.reshape(-1), position.reshape(-1))
    return groups.number.reshape(position.shape)


def visit_slots(trajectory: Trajectory) -> jax.Array:
    """i32[T + 1, B]: the slot of every observation in a table of `VISIT_SLOTS`."""
    position = _position_ids(trajectory.layout, trajectory.cells)
    code = distinct.layout_hash(trajectory.layout)[None] + position.astype(jnp.uint32)
    # The finaliser of MurmurHash3: every bit of the code moves every bit of the slot.
    code = (code ^ (code >> 16)) * jnp.uint32(0x85EBCA6B)
    code = (code ^ (code >> 13)) * jnp.uint32(0xC2B2AE35)
    return ((code ^ (code >> 16)) % VISIT_SLOTS).astype(jnp.int32)


def first_visits(observation_id: jax.Array) -> jax.Array:
    """f32[T + 1, B]: 1 where an observation is new in its episode, 0 where it returns."""
    time = jnp.arange(len(observation_id))
    same = observation_id[:, None] == observation_id[None]
    earlier = (time[:, None] > time[None])[..., None]
    return 1.0 - jnp.any(same & earlier, axis=1)


def _position_ids(layout: tt.State, cells: jax.Array) -> jax.Array:
    """i32[T + 1, B]: the ids of where agent, tool and food are."""
    states = jax.vmap(jax.vmap(place), in_axes=(None, 0))(layout, cells)
    return jax.vmap(jax.vmap(distinct.position_id))(states)


def _curiosity_reward(agent: Agent, params: Params, trajectory: Trajectory) -> jax.Array:
    """The raw intrinsic reward f32[T, B]."""
    _, next_embedding = agent.unroll_both(
        params, trajectory.features, trajectory.action, trajectory.reward
    )
    prediction = agent.predict(
        params, trajectory.embedding, next_embedding, trajectory.features, trajectory.action
    )
    return intrinsic_reward(prediction)


def _environment(config: Config, env: Environment | None) -> Environment:
    if env is None:
        return tt.make(config.env_id, num_features=config.num_features, max_steps=config.max_steps)
    for name in ("num_features", "max_steps"):
        if getattr(env, name) != getattr(config, name):
            raise ValueError(
                f"the environment's {name} is {getattr(env, name)}, the config's "
                f"{getattr(config, name)}; they must agree"
            )
    return env
