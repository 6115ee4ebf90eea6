"""PPO with curiosity: one iteration of training as one pure function.

`Learner.iterate` draws tasks, plays them, computes intrinsic rewards and advantages, and takes
gradient steps on minibatches; the methods below it follow in this order.

Source: Schulman et al. (2017); paper, section "Results"; agents/agent.md, "PPO" and "Curiosity".
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

import trap_tube_jax as tt
from agents.acting.encoding import Encoding
from agents.acting.episodes import Episodes
from agents.acting.rollout import Trajectory, rollout
from agents.config import Config
from agents.curiosity import Curiosity, Experience, make_curiosity
from agents.networks.agent import Agent, Params
from agents.networks.layers import init_module
from agents.parallel.devices import ONE_DEVICE, EpisodeAxis
from agents.ppo import advantages, losses, machine, returns
from agents.ppo.motion import MotionHead, motion_loss
from agents.ppo.optimizer import make_optimizer
from agents.ppo.task_replay import TaskReplay
from trap_tube_jax.objects import BOARD_SIZE
from trap_tube_jax.state import take

Metrics = dict[str, jax.Array]


class TrainState(NamedTuple):
    """Everything that training carries from one iteration to the next.

    Attributes:
      params: parameters by part: `encoder`, `core`, `heads` of the policy network, `curiosity`, and
        `motion` if `motion_coef` is above 0.
      opt_state: state of the optimizer.
      reward_variance: f32[2], moving averages; see `agents.ppo.advantages.update_variance`.
      memory: memory of the curiosity.
      task_replay: failed tasks to replay.
      key: PRNG key of all iterations to come.
      iteration: i32[], iterations done.
      transitions: i32[], environment steps taken.

    Example:
      >>> learner = agents.make_learner(agents.Config.preset("fast"))
      >>> state = learner.init(jax.random.key(0))
      >>> sorted(state.params), int(state.iteration)
      (['core', 'curiosity', 'encoder', 'heads'], 0)
    """

    params: Params
    opt_state: Any
    reward_variance: jax.Array
    memory: Any
    task_replay: TaskReplay
    key: jax.Array
    iteration: jax.Array
    transitions: jax.Array


class Batch(NamedTuple):
    """B episodes as the loss sees them.

    Attributes:
      episodes: the episodes.
      log_prob: f32[B, T], log-probabilities of the actions under the acting parameters.
      advantage: f32[B, T], normalised.
      value_target: f32[B, T, V], one for each value head.
    """

    episodes: Episodes
    log_prob: jax.Array
    advantage: jax.Array
    value_target: jax.Array


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True, eq=False)
class Learner:
    """The parts of training as pure functions of arrays; holds no parameters.

    `init` and `iterate` are all that training needs: jit `iterate`, and vmap both over seeds. A
    learner is a pytree without leaves, so it can be an argument of a jitted function. To change a
    setting, build another learner: replacing `config` alone keeps optimizer and network.

    Attributes:
      config: settings.
      env: environment.
      agent: functions of the policy network.
      encoding: encodes observations, one by one or faster.
      curiosity: intrinsic reward.
      optimizer: gradient clipping and Adam.
      axis: devices that share the episodes of an iteration.

    Example:
      >>> config = agents.Config.preset("fast", episodes_per_iteration=64, filters=(4, 8))
      >>> learner = agents.make_learner(config)
      >>> state = learner.init(jax.random.key(0))
      >>> state, metrics = jax.jit(learner.iterate)(state)
      >>> int(state.iteration), metrics["loss"].shape
      (1, ())
    """

    config: Config
    env: tt.Environment
    agent: Agent
    encoding: Encoding
    curiosity: Curiosity
    optimizer: optax.GradientTransformation
    axis: EpisodeAxis = ONE_DEVICE

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles what it was made of, since the optimizer is made of closures."""
        return make_learner, (self.config, self.env, self.axis)

    def init(self, key: jax.Array) -> TrainState:
        """Returns the first state; draws the parameters with `key`, one PRNG key."""
        return jax.jit(self._init)(key)  # compiled as a whole in a fraction of the time

    def _init(self, key: jax.Array) -> TrainState:
        config = self.config
        params_key, replay_key, key = jax.random.split(key, 3)
        agent_key, curiosity_key, motion_key = jax.random.split(params_key, 3)
        board = jnp.zeros((1, BOARD_SIZE, BOARD_SIZE, config.num_features), jnp.uint8)
        curiosity = self.curiosity.init(curiosity_key, board)
        params = {**self.agent.init(agent_key), "curiosity": curiosity}
        if config.motion_coef:
            hidden = jnp.zeros((1, config.hidden), jnp.float32)
            action = self.agent.embed_action(params, jnp.zeros((1, 2), jnp.int32))
            params["motion"] = init_module(MotionHead(), motion_key, hidden, action)
        zero = jnp.zeros((), jnp.int32)
        return TrainState(
            params=params,
            opt_state=self.optimizer.init(params),
            reward_variance=jnp.zeros(2, jnp.float32),
            memory=self.curiosity.memory(),
            task_replay=TaskReplay.untried(
                replay_key, len(config.replay_fractions), config.replay_capacity
            ),
            key=key,
            iteration=zero,
            transitions=zero,
        )

    def iterate(self, state: TrainState) -> tuple[TrainState, Metrics]:
        """Plays one iteration's episodes and learns from them.

        Returns the next state, and the iteration's metrics, f32[] each.
        """
        reset_key, action_key, update_key, key = jax.random.split(state.key, 4)
        reset_keys = self.draw_tasks(state.task_replay, reset_key)
        trajectory = self.play(
            state.params, self.axis.part(reset_keys), self.axis.device_key(action_key)
        )
        intrinsic_reward, memory = self.intrinsic_reward(state, trajectory)
        batch, reward_variance = self.make_batch(state, trajectory, intrinsic_reward)
        params, opt_state, update_metrics = self.update(state, batch, update_key)

        solved = self.axis.gather(trajectory.episodes.solved)
        steps = jnp.sum(self.axis.gather(trajectory.episodes.length), dtype=jnp.int32)
        metrics = self.play_metrics(trajectory.episodes, intrinsic_reward, solved) | update_metrics
        next_state = TrainState(
            params=params,
            opt_state=opt_state,
            reward_variance=reward_variance,
            memory=self.axis.mean(memory),
            task_replay=state.task_replay.remember(reset_keys, ~solved, self.config.num_replayed),
            key=key,
            iteration=state.iteration + 1,
            transitions=state.transitions + steps,
        )
        return next_state, metrics

    def draw_tasks(self, task_replay: TaskReplay, key: jax.Array) -> jax.Array:
        """Draws the reset keys [B] of an iteration: new tasks first, then tasks failed before."""
        config = self.config
        if not config.replay_fractions:
            return jax.random.split(key, config.episodes_per_iteration)
        replay_key, key = jax.random.split(key)
        new = jax.random.split(key, config.num_new)
        return jnp.concatenate([new, task_replay.draw(replay_key, config.num_replayed)])

    def play(self, params: Params, reset_keys: jax.Array, action_key: jax.Array) -> Trajectory:
        """Plays one episode from each reset key [B], with sampled actions."""
        initial, _ = jax.vmap(self.env.reset)(reset_keys)
        return rollout(self.agent, params, self.env, initial, action_key, self.encoding)

    def intrinsic_reward(self, state: TrainState, trajectory: Trajectory) -> tuple[jax.Array, Any]:
        """Computes the curiosity's reward of every step, under the parameters that acted.

        Returns the reward f32[B, T], 0 after an episode's end, and the curiosity's new memory.
        """
        experience = self.experience(state.params, trajectory.episodes)
        mask = trajectory.episodes.mask
        params = state.params["curiosity"]
        reward, memory = self.curiosity.reward(params, state.memory, experience)
        return jnp.where(mask > 0, reward, 0.0), memory

    def make_batch(
        self, state: TrainState, trajectory: Trajectory, intrinsic_reward: jax.Array
    ) -> tuple[Batch, jax.Array]:
        """Computes advantages and value targets, by intrinsic rewards f32[B, T].

        Returns the batch, and the variances f32[2] of both rewards; see `agents.ppo.advantages`.
        """
        config = self.config
        episodes = trajectory.episodes
        variance = advantages.update_variance(
            config, state.reward_variance, state.iteration, episodes, intrinsic_reward
        )
        variance = self.axis.mean(variance)
        coef = advantages.intrinsic_coef_schedule(config)(state.iteration)
        advantage, target = advantages.estimate(
            config, episodes, intrinsic_reward, coef, trajectory.value, variance
        )
        advantage = returns.normalize(advantage, episodes.mask)
        return Batch(episodes, trajectory.log_prob, advantage, target), variance

    def update(
        self, state: TrainState, batch: Batch, key: jax.Array
    ) -> tuple[Params, Any, Metrics]:
        """Takes `epochs` passes of gradient steps over shuffled minibatches of whole episodes.

        On several devices each minibatch is made of equal parts of every device's episodes.

        Returns:
          Parameters, state of the optimizer, and metrics averaged over gradient steps.
        """
        num_episodes = self.config.episodes_per_iteration // self.axis.size
        minibatch_size = self.config.minibatch_size // self.axis.size

        def step(carry: tuple[Params, Any], index: jax.Array) -> tuple[Any, Metrics]:
            params, opt_state = carry
            gradient, metrics = self.axis.mean(
                jax.grad(self.loss, has_aux=True)(params, take(batch, index))
            )
            updates, opt_state = self.optimizer.update(gradient, opt_state, params)
            metrics["gradient_norm"] = optax.tree.norm(gradient)
            return (optax.apply_updates(params, updates), opt_state), metrics

        keys = jax.random.split(key, self.config.epochs)
        orders = jax.vmap(lambda key: jax.random.permutation(key, num_episodes))(keys)
        (params, opt_state), metrics = jax.lax.scan(
            step, (state.params, state.opt_state), orders.reshape(-1, minibatch_size)
        )
        return params, opt_state, jax.tree.map(jnp.mean, metrics)

    def loss(self, params: Params, batch: Batch) -> tuple[jax.Array, Metrics]:
        """Computes the loss of a minibatch.

          L = policy + value - entropy + curiosity_coef * curiosity's losses + motion_coef * motion

        Returns:
          L f32[] and metrics: its terms as weighted in L, and the mean entropy of a step.

        Raises:
          ValueError: the name of a curiosity's loss is another term's or does not end in
            `_loss`.
        """
        config = self.config
        mask = batch.episodes.mask
        experience = self.experience(params, batch.episodes)
        actions, value = self.agent.policy_and_value(params, experience.hidden)
        log_prob = actions.log_prob(batch.episodes.action)
        surrogate = losses.clipped_surrogate(
            log_prob, batch.log_prob, batch.advantage, config.clip_eps
        )
        value_error = jnp.sum(optax.squared_error(value, batch.value_target), axis=-1)
        entropy = actions.entropy()
        terms = {
            "policy_loss": losses.padded_mean(surrogate, mask),
            "value_loss": config.value_coef * losses.padded_mean(value_error, mask),
            "entropy_loss": -config.entropy_coef * losses.padded_mean(entropy, mask),
        }
        if config.motion_coef:
            logits: Any = MotionHead().apply(
                params["motion"], experience.hidden, experience.action_embedding
            )
            motion = motion_loss(logits, batch.episodes.cells)
            terms["motion_loss"] = config.motion_coef * losses.padded_mean(motion, mask)
        for name, term in self.curiosity.losses(params["curiosity"], experience).items():
            terms[name] = config.curiosity_coef * losses.padded_mean(term, mask)
        total = sum(terms.values(), jnp.zeros((), jnp.float32))
        mean_entropy = jnp.sum(entropy * mask) / jnp.sum(mask)
        return total, {**terms, "loss": total, "entropy": mean_entropy}

    def experience(self, params: Params, episodes: Episodes) -> Experience:
        """Returns the curiosity's view of episodes under `params`, differentiable by them."""
        features, curiosity_features = self.encoding.encode_episodes(params, episodes)
        hidden, next_hidden = self.agent.unroll(
            params,
            features,
            episodes.action,
            episodes.reward,
            with_next=self.curiosity.needs_next_hidden,
        )
        action_embedding = self.agent.embed_action(params, episodes.action)
        return Experience(episodes, curiosity_features, hidden, next_hidden, action_embedding)

    def play_metrics(
        self, episodes: Episodes, intrinsic_reward: jax.Array, solved: jax.Array
    ) -> Metrics:
        """Returns metrics of the episodes; `solved` bool[B] is of all devices."""
        metrics = self.axis.mean(
            {
                "episode_length": jnp.mean(episodes.length.astype(jnp.float32)),
                "intrinsic_reward": jnp.sum(intrinsic_reward) / jnp.sum(episodes.mask),
            }
        )
        new, replayed = jnp.split(solved.astype(jnp.float32), [self.config.num_new])
        metrics["success"] = jnp.mean(new)
        if len(replayed):
            metrics["replayed_success"] = jnp.mean(replayed)
        return metrics


def make_learner(
    config: Config, env: tt.Environment | None = None, axis: EpisodeAxis = ONE_DEVICE
) -> Learner:
    """Builds the learner for some settings, with the path that suits the machine.

    Args:
      config: settings.
      env: environment; by default the task set `config.env_id`. A subclass must keep board and
        palette within an episode: observations are redrawn from positions.
      axis: devices that share the episodes; `Placement.axis` on several devices.

    Raises:
      ValueError: `env` contradicts `config`, the curiosity does not suit the environment or the
        devices, or there are too many environment steps to count.

    Example:
      >>> config = agents.Config.preset("fast", max_steps=30)
      >>> agents.make_learner(config, tt.make("p", max_steps=30)).env
      Environment(transfers=(perceptual), max_steps=30)
    """
    if env is None:
        env = tt.make(config.env_id, num_features=config.num_features, max_steps=config.max_steps)
    config.validate(env)
    agent = machine.make_agent(config)
    jax.eval_shape(agent.init, jax.random.key(0))  # names an encoder that the curiosity uses, too
    curiosity = make_curiosity(config, env)
    memory = jax.tree.leaves(jax.eval_shape(curiosity.memory))
    if axis.size > 1 and not all(jnp.issubdtype(x.dtype, jnp.floating) for x in memory):
        raise ValueError(
            f"curiosity {config.curiosity!r} cannot train on several devices: they average its "
            "memory, so its arrays must be floats"
        )
    encoding = machine.make_encoding(agent, curiosity.encode)
    return Learner(config, env, agent, encoding, curiosity, make_optimizer(config), axis)
