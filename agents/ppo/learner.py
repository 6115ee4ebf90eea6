"""PPO with curiosity: one iteration of training as one pure function.

Read `Learner.iterate` first: it plays episodes, prepares a batch of them (rewards, advantages) and
takes gradient steps on minibatches.

Source: Schulman et al. (2017); paper, section "Results"; agents/agent.md, "PPO" and "Curiosity".
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax

from agents.acting.encodings import encode_episodes
from agents.acting.episodes import Episodes, along_episodes, take
from agents.acting.frames import Frame
from agents.acting.identity import observation_ids
from agents.acting.rollout import Trajectory, rollout, sample_action
from agents.config import Config
from agents.curiosity import Curiosity, Experience
from agents.curiosity.checks import check_curiosity
from agents.networks.agent import Agent, Params
from agents.parallel.sharding import ALONE, Shards
from agents.ppo import advantages, losses, returns
from agents.ppo.optimizer import make_optimizer
from agents.ppo.task_replay import TaskReplay
from agents.registry import curiosities
from trap_tube_jax.environment import Environment
from trap_tube_jax.objects import BOARD_SIZE
from trap_tube_jax.registry import make

Metrics = dict[str, jax.Array]

COUNTABLE = np.iinfo(np.int32).max  # by `TrainState.transitions`

# The names of all other metrics, which a curiosity's losses may not have: those of play, of
# gradient steps, and what a run adds to them. Those of evaluations begin with GREEDY.
RESERVED_NAMES = {
    "success",
    "replayed_success",
    "episode_length",
    "intrinsic_reward",
    "distinct_observations",
    "policy_loss",
    "value_loss",
    "entropy_loss",
    "loss",
    "entropy",
    "steps",
    "gradient_norm",
    "seed",
    "iteration",
    "episodes",
    "transitions",
    "evaluation",
    "seconds",
    "transitions_per_second",
}
GREEDY = "greedy_"


class TrainState(NamedTuple):
    """Everything that training carries from one iteration to the next.

    Attributes:
      params: `encoder`, `core`, `heads` of the policy network, and `curiosity`.
      opt_state: the optimizer's state.
      extrinsic: moments of the extrinsic reward.
      intrinsic: moments of the intrinsic reward, or of its returns where rewards are apart.
      memory: what the curiosity carries along.
      task_replay: failed tasks, to be played again.
      key: PRNG key of all iterations to come.
      iteration: i32[], iterations done.
      episodes: i32[], episodes played.
      transitions: i32[], environment steps taken.
    """

    params: Params
    opt_state: Any
    extrinsic: returns.Moments
    intrinsic: returns.Moments
    memory: Any
    task_replay: TaskReplay
    key: jax.Array
    iteration: jax.Array
    episodes: jax.Array
    transitions: jax.Array


class Batch(NamedTuple):
    """What gradient steps see of B episodes.

    Attributes:
      episodes: the episodes.
      observation_id: i32[T + 1, B], equal only for equal observations.
      log_prob: f32[T, B], of the actions under the acting parameters.
      advantage: f32[T, B], normalised.
      value_target: f32[T, B, V], for each stream of rewards.
    """

    episodes: Episodes
    observation_id: jax.Array
    log_prob: jax.Array
    advantage: jax.Array
    value_target: jax.Array


@dataclasses.dataclass(frozen=True, eq=False)
class Learner:
    """The parts of training, and what one iteration does with them. Holds no parameters.

    `init` and `iterate` are all that training needs: jit `iterate`, and vmap both over seeds. All
    methods are pure functions of arrays.

    Attributes:
      config: the settings.
      env: the environment.
      agent: the policy network's functions.
      curiosity: the intrinsic reward.
      optimizer: clip and Adam.
      shards: how `iterate` divides its episodes over devices.
    """

    config: Config
    env: Environment
    agent: Agent
    curiosity: Curiosity
    optimizer: optax.GradientTransformation
    shards: Shards = ALONE

    @functools.partial(jax.jit, static_argnums=0)
    def init(self, key: jax.Array) -> TrainState:
        """The first state, compiled as one program."""
        params_key, failures_key, key = jax.random.split(key, 3)
        params = self.init_params(params_key)
        zero = jnp.zeros((), jnp.int32)
        return TrainState(
            params=params,
            opt_state=self.optimizer.init(params),
            extrinsic=returns.Moments.zero(),
            intrinsic=returns.Moments.zero(),
            memory=self.curiosity.memory(),
            task_replay=TaskReplay.untried(
                failures_key, len(self.config.replay_fractions), self.config.replay_capacity
            ),
            key=key,
            iteration=zero,
            episodes=zero,
            transitions=zero,
        )

    def init_params(self, key: jax.Array) -> Params:
        """Fresh parameters of the policy network and of the curiosity, which may have none."""
        agent_key, curiosity_key = jax.random.split(key)
        board = jnp.zeros((1, BOARD_SIZE, BOARD_SIZE, self.config.num_features), jnp.uint8)
        own = self.curiosity.init(curiosity_key, board)
        return {**self.agent.init(agent_key), "curiosity": own}

    def iterate(self, state: TrainState) -> tuple[TrainState, Metrics]:
        """Collects and learns: the next state, and metrics f32[] each."""
        state, batch, play_metrics = self.collect(state)
        state, loss_metrics = self.learn(state, batch)
        return state, {**play_metrics, **loss_metrics, 'is_finite': jnp.float32(1)}

    def collect(self, state: TrainState) -> tuple[TrainState, Batch, Metrics]:
        """Plays an iteration's episodes: the state, brought up to date; a batch; metrics of play.

        The parameters are those before. `learn` is to follow.
        """
        reset_key, action_key, _, _ = _keys(state)
        reset_keys = self.draw_tasks(state.task_replay, reset_key)
        trajectory = self.play(state.params, reset_keys, action_key)
        state, batch, metrics = self.prepare(state, trajectory)
        if again := self.config.num_replayed:
            task_replay = state.task_replay.remember(reset_keys, ~batch.episodes.solved, again)
            state = state._replace(task_replay=task_replay)
        return state, batch, metrics

    def learn(self, state: TrainState, batch: Batch) -> tuple[TrainState, Metrics]:
        """Learns from the batch that `collect` returned with this state."""
        _, _, update_key, key = _keys(state)
        params, opt_state, metrics = self.optimize(state, batch, update_key)
        state = state._replace(
            params=params,
            opt_state=opt_state,
            key=key,
            iteration=state.iteration + 1,
            episodes=state.episodes + self.config.episodes_per_iteration,
        )
        return state, metrics

    def draw_tasks(self, task_replay: TaskReplay, key: jax.Array) -> jax.Array:
        """The reset keys [B] of an iteration's tasks: first new ones, then those failed before."""
        config = self.config
        if not config.replay_fractions:
            return jax.random.split(key, config.episodes_per_iteration)
        failures_key, key = jax.random.split(key)
        new = jax.random.split(key, config.num_new)
        return jnp.concatenate([new, task_replay.draw(failures_key, config.num_replayed)])

    def play(self, params: Params, reset_keys: jax.Array, action_key: jax.Array) -> Trajectory:
        """Plays this device's share of an iteration's episodes."""
        initial, timestep = jax.vmap(self.env.reset)(self.shards.part(reset_keys))
        if self.config.align_to_food:
            frame = jax.vmap(Frame.facing_food)(timestep.observation)
            initial = jax.vmap(Frame.state)(frame, initial)
        choose = self.shards.drawing(sample_action)
        return rollout(self.agent, params, self.env, initial, action_key, choose=choose)

    def prepare(
        self, state: TrainState, trajectory: Trajectory
    ) -> tuple[TrainState, Batch, Metrics]:
        """Turns episodes into what the gradient steps learn from, under the acting parameters.

        Args:
          state: the state of training.
          trajectory: this device's episodes.

        Returns:
          The state with rewards' moments, curiosity's memory and transitions brought up to date;
          the batch of all devices' episodes; and metrics of play.
        """
        config = self.config
        novelty, memory = self.intrinsic_reward(state, trajectory)
        episodes = self._whole(trajectory.episodes)
        log_prob, value = self.shards.whole((trajectory.log_prob, trajectory.value), axis=1)
        join = (
            advantages.combined_advantages
            if config.value_heads == "shared"
            else advantages.separate_advantages
        )
        moments = (state.extrinsic, state.intrinsic)
        scale = advantages.intrinsic_scale(config)(state.iteration)
        advantage, target, moments = join(config, episodes, novelty, scale, value, moments)
        batch = Batch(
            episodes=episodes,
            observation_id=observation_ids(episodes),
            log_prob=log_prob,
            advantage=returns.normalize(advantage, episodes.mask),
            value_target=target,
        )
        metrics = {
            "success": jnp.mean(episodes.solved[: config.num_new].astype(jnp.float32)),
            "episode_length": jnp.mean(episodes.length.astype(jnp.float32)),
            "intrinsic_reward": jnp.sum(novelty) / jnp.sum(episodes.mask),
            "distinct_observations": jnp.max(batch.observation_id) + 1,
        }
        if sum(config.num_replayed):
            solved = episodes.solved[config.num_new :]
            metrics["replayed_success"] = jnp.mean(solved.astype(jnp.float32))
        state = state._replace(
            extrinsic=moments[0],
            intrinsic=moments[1],
            memory=memory,
            transitions=state.transitions + jnp.sum(episodes.length),
        )
        return state, batch, metrics

    def intrinsic_reward(self, state: TrainState, trajectory: Trajectory) -> tuple[jax.Array, Any]:
        """The intrinsic reward f32[T, B] of all devices' episodes, and the curiosity's new memory.

        It is 0 after an episode's end.
        """
        experience = self.acting_experience(state.params, trajectory)
        if self.curiosity.needs_all_episodes:
            experience = self._whole(experience)
            # Devices number their observations apart.
            everyones = observation_ids(experience.episodes)
            experience = experience._replace(observation_id=everyones)
        reward, memory = self.curiosity.reward(state.params["curiosity"], state.memory, experience)
        mask = experience.episodes.mask
        chex.assert_equal_shape([reward, mask])
        reward = jnp.where(mask > 0, reward, 0.0)
        if not self.curiosity.needs_all_episodes:
            reward = self.shards.whole(reward, axis=1)
        return reward, memory

    def acting_experience(self, params: Params, trajectory: Trajectory) -> Experience:
        """What the curiosity sees of episodes when it pays for them."""
        episodes = trajectory.episodes
        observation_id = observation_ids(episodes)
        features = jnp.zeros((*observation_id.shape, 0))
        if type(self.curiosity).encode is not Curiosity.encode:
            own = params["curiosity"]

            def encode(own: Params, rows: jax.Array, _: None) -> tuple[jax.Array, None]:
                return self.curiosity.encode(own, rows), None

            features = encode_episodes(
                encode, own, episodes, observation_id, chunk=self.config.encode_chunk_size
            )
        experience = Experience(episodes, observation_id, features)
        if not self.curiosity.needs_embeddings:
            return experience
        _, after = self.agent.unroll_both(
            params, trajectory.features, episodes.action, episodes.reward
        )
        return experience._replace(
            embedding=trajectory.embedding,
            next_embedding=after,
            action_embedding=self.agent.embed_action(params, episodes.action),
        )

    def optimize(
        self, state: TrainState, batch: Batch, key: jax.Array
    ) -> tuple[Params, Any, Metrics]:
        """All epochs of gradient steps on minibatches of whole episodes, shuffled in each.

        Every device differentiates its part of each minibatch; the mean is everyone's gradient.
        """
        config = self.config

        def update(carry: tuple[Params, Any], places: jax.Array) -> tuple[Any, Metrics]:
            params, opt_state = carry
            own = take(batch, self.shards.part(places))
            gradient, metrics = self.shards.mean(jax.grad(self.loss, has_aux=True)(params, own))
            updates, opt_state = self.optimizer.update(gradient, opt_state, params)
            metrics["gradient_norm"] = optax.tree.norm(gradient)
            metrics["entropy"] /= metrics.pop("steps")
            return (optax.apply_updates(params, updates), opt_state), metrics

        def permute(epoch_key: jax.Array) -> jax.Array:
            order = jax.random.permutation(epoch_key, config.episodes_per_iteration)
            return order.reshape(-1, config.minibatch_size)

        minibatches = jax.vmap(permute)(jax.random.split(key, config.epochs))
        (params, opt_state), metrics = jax.lax.scan(
            update, (state.params, state.opt_state), minibatches.reshape(-1, config.minibatch_size)
        )
        return params, opt_state, jax.tree.map(jnp.mean, metrics)

    def loss(self, params: Params, batch: Batch) -> tuple[jax.Array, Metrics]:
        """The total loss f32[] and its terms, weighted as they enter it.

        Their mean over devices is the whole minibatch's.

          L = policy + value - entropy + curiosity_coef * curiosity's losses

        Also returned: `entropy`, summed over the steps before an episode's end, and `steps`, their
        number.

        Args:
          params: the parameters to differentiate by.
          batch: this device's part of a minibatch.

        Raises:
          ValueError: the curiosity calls a loss of its own like a metric.
        """
        config, mask = self.config, batch.episodes.mask
        embedding, experience = self.learning_experience(params, batch)
        actions, value = self.agent.policy_and_value(params, embedding)
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
        own = self.curiosity.losses(params["curiosity"], experience)
        if taken := {name for name in own if name in RESERVED_NAMES or name.startswith(GREEDY)}:
            raise ValueError(
                f"a curiosity's losses need names of their own, got {', '.join(sorted(taken))}"
            )
        for name, term in own.items():
            terms[name] = config.curiosity_coef * losses.padded_mean(term, mask)
        total = sum(terms.values(), jnp.zeros(()))
        sums = {"entropy": jnp.sum(entropy * mask), "steps": jnp.sum(mask)}
        return total, {**terms, "loss": total, **sums}

    def learning_experience(self, params: Params, batch: Batch) -> tuple[jax.Array, Experience]:
        """The GRU's outputs f32[T, B, hidden], and what the curiosity sees of a minibatch."""
        episodes = batch.episodes
        read = {name: params[name] for name in ("encoder", "curiosity")}

        def encode(params: Params, rows: jax.Array, remembered: Any) -> Any:
            features, remembered = self.agent.encode_rows(params, rows, remembered)
            return (features, self.curiosity.encode(params["curiosity"], rows)), remembered

        features, own = encode_episodes(
            encode, read, episodes, batch.observation_id, chunk=self.config.encode_chunk_size
        )
        experience = Experience(episodes, batch.observation_id, own)
        given = (params, features, episodes.action, episodes.reward)
        if not self.curiosity.needs_embeddings:
            return self.agent.unroll(*given), experience
        embedding, after = self.agent.unroll_both(*given)
        return embedding, experience._replace(
            embedding=embedding,
            next_embedding=after,
            action_embedding=self.agent.embed_action(params, episodes.action),
        )

    def _whole(self, record: Any) -> Any:
        """A record of all devices' episodes from those of each."""
        return along_episodes(lambda axis, x: self.shards.whole(x, axis), record)


def _keys(state: TrainState) -> jax.Array:
    """Those of an iteration's resets, actions and gradient steps, and that of what follows."""
    return jax.random.split(state.key, 4)


def memory_estimate(c): return 1
def make_train(config: Config, env: Environment | None = None, shards: Shards = ALONE, axis=None) -> Learner:
    """Builds training from its settings.

    Args:
      config: the settings.
      env: an environment of your own; that of `config.env_id` if absent.
      shards: how to divide the episodes; more than one only within `Placement.shard`.

    Raises:
      ValueError: `env` contradicts `config`, the curiosity is not for this environment or, if it is
        your own, breaks its contract, or the environment steps are too many to count.
    """
    if env is None:
        env = make(config.env_id, num_features=config.num_features, max_steps=config.max_steps)
    for name in ("num_features", "max_steps"):
        if getattr(config, name) not in (None, getattr(env, name)):
            raise ValueError(
                f"the environment's {name} is {getattr(env, name)}, the config's "
                f"{getattr(config, name)}; they must agree"
            )
    steps = config.iterations * config.episodes_per_iteration * env.max_steps
    if min(steps, config.max_transitions or steps) > COUNTABLE:
        raise ValueError(
            f"iterations={config.iterations} of {config.episodes_per_iteration} episodes of {env.max_steps} "
            f"steps are {steps:,} steps; allowed: at most {COUNTABLE:,}"
        )
    curiosity = curiosities.factory(config.curiosity)(config, env)
    if type(curiosity).__module__.split(".")[0] != "agents":
        check_curiosity(curiosity, config, env)
    return Learner(config, env, Agent(config), curiosity, make_optimizer(config), shards)
