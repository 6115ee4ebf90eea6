"""Learning from what walks found out: dataset aggregation with an adviser made of experience.

Every iteration draws new tasks, has random walks explore them (`agents.dagger.explore`), and
lets the agent play each of them many times. Whatever states it comes to, the atlas of the walks says
which actions bring the goal nearest; the agent learns to take one of them. In some episodes
its actions are now and then replaced by what the atlas advises, so that early on there is
something to see beyond the start. Episodes of many iterations are kept and learnt from again.

The atlas is nothing that an agent could not have found out by itself: it is made of steps in
the environment, and knows only what they came across; `Config.environment_steps` counts them
all. The agent sees none of it, neither in its observations nor as a reward. It has to tell from
observations what to do, and where they do not say (which opening is the exit), to try and to
remember: the atlas knows that, the agent does not, and learns what is right on average until its
own attempts have shown more.

Source: Ross, Gordon and Bagnell (2011), with Anthony, Tian and Barber (2017)'s idea that the
expert be the learner's own search.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from agents.acting.observations import encode_episodes, observation_ids
from agents.acting.rollout import Trajectory, place, rollout, sample_action
from agents.config import Config
from agents.dagger.explore import UNKNOWN, Atlas, explore, look_ahead, walk
from agents.dagger.symmetry import NUM_SYMMETRIES, Symmetry
from agents.networks.agent import Agent, Params
from agents.networks.core import Outputs
from agents.networks.distinct import position_id
from agents.parallel.sharding import ALONE, Shards
from agents.ppo import losses
from agents.ppo.method import Metrics, Train, environment
from agents.ppo.optimizer import cooldown, make_optimizer
from trap_tube_jax.environment import Environment, action_from_index, action_to_index
from trap_tube_jax.objects import NUM_ACTIONS
from trap_tube_jax.registry import make
from trap_tube_jax.state import State

IMPOSSIBLE = -1e9  # a log-probability
ACTIONS = np.arange(NUM_ACTIONS)


class Lesson(NamedTuple):
    """B episodes of T steps and what would have been right in them.

    Attributes:
      trajectory: the episodes.
      right: u16[T, B], a bit for each of the 16 actions that are right; 0 after the
        episode's end and where nothing is known.
      known: u16[T, B], a bit for each action of which it is known whether it is right.
    """

    trajectory: Trajectory
    right: jax.Array
    known: jax.Array


class Dataset(NamedTuple):
    """The newest K episodes of T steps, with advice; the oldest is the next to be replaced.

    Attributes:
      layout: K states, of which board, palette and tool extent hold for the episode.
      cells: u8[T + 1, K, 3, 2], the (row, column) of agent, tool and food.
      action: u8[T, K, 2].
      right: u16[T, K]; see `Lesson`.
      known: u16[T, K]; see `Lesson`.
      added: i32[], episodes ever added.
    """

    layout: State
    cells: jax.Array
    action: jax.Array
    right: jax.Array
    known: jax.Array
    added: jax.Array

    @staticmethod
    def empty(config: Config, base: State) -> "Dataset":
        """One with room for `config.dataset` episodes."""
        capacity, steps = config.dataset, config.max_steps
        return Dataset(
            layout=jax.tree.map(lambda x: jnp.broadcast_to(x, (capacity, *x.shape)), base),
            cells=jnp.zeros((steps + 1, capacity, 3, 2), jnp.uint8),
            action=jnp.zeros((steps, capacity, 2), jnp.uint8),
            right=jnp.zeros((steps, capacity), jnp.uint16),
            known=jnp.zeros((steps, capacity), jnp.uint16),
            added=jnp.zeros((), jnp.int32),
        )

    @property
    def number(self) -> jax.Array:
        """i32[]: the episodes that there are."""
        return jnp.minimum(self.added, self.right.shape[1])

    def add(self, lesson: Lesson) -> "Dataset":
        """Replaces the oldest B episodes, of which K is a multiple."""
        trajectory = lesson.trajectory
        batch = lesson.right.shape[1]
        spot = self.added % self.right.shape[1]

        def put(old: jax.Array, new: jax.Array, axis: int) -> jax.Array:
            return jax.lax.dynamic_update_slice_in_dim(old, new.astype(old.dtype), spot, axis)

        layout = jax.tree.map(lambda old, new: put(old, new, 0), self.layout, trajectory.layout)
        return Dataset(
            layout=layout,
            cells=put(self.cells, trajectory.cells, 1),
            action=put(self.action, trajectory.action, 1),
            right=put(self.right, lesson.right, 1),
            known=put(self.known, lesson.known, 1),
            added=self.added + batch,
        )

    def take(self, episodes: jax.Array) -> "Dataset":
        """The episodes at these places, i32[M]."""
        return Dataset(
            layout=jax.tree.map(lambda x: x[episodes], self.layout),
            cells=self.cells[:, episodes],
            action=self.action[:, episodes],
            right=self.right[:, episodes],
            known=self.known[:, episodes],
            added=self.added,
        )

    def mirrored(self, symmetry: Symmetry) -> "Dataset":
        """The image of all episodes under a symmetry of the board."""
        image = symmetry.directions()
        number = action_to_index(image[action_from_index(jnp.asarray(ACTIONS))])

        def permuted(bits: jax.Array) -> jax.Array:
            flags = _from_bits(bits)
            return _as_bits(jnp.zeros_like(flags).at[..., number].set(flags))

        return Dataset(
            layout=symmetry.layout(self.layout),
            cells=symmetry.cells(self.cells, self.layout.tool_extent),
            action=image[self.action].astype(self.action.dtype),
            right=permuted(self.right),
            known=permuted(self.known),
            added=self.added,
        )


class TrainState(NamedTuple):
    """Everything that training carries from one iteration to the next.

    Attributes:
      params: the network's parameters.
      opt_state: the optimiser's state.
      dataset: episodes to learn from.
      key: PRNG key of all iterations to come.
      iteration: i32[], iterations done.
      episodes: i32[], episodes played.
      transitions: i32[], environment steps taken with the network; walks come on top.
    """

    params: Params
    opt_state: Any
    dataset: Dataset
    key: jax.Array
    iteration: jax.Array
    episodes: jax.Array
    transitions: jax.Array


def make_train(config: Config, env: Environment | None = None, shards: Shards = ALONE) -> Train:
    """Builds training from its settings.

    Args:
      config: the settings.
      env: an environment of your own; that of `config.env_id` if absent.
      shards: how to divide the tasks; more than one only within `Placement.shard`.

    Raises:
      ValueError: `env` contradicts `config`.
    """
    env = environment(config, env)
    agent = Agent(config)
    optimizer = make_optimizer(config)
    sources = [
        make(name, num_features=config.num_features, max_steps=config.max_steps)
        for name in config.task_sets
    ] or [env]

    def init(key: jax.Array) -> TrainState:
        params_key, key = jax.random.split(key)
        params = agent.init(params_key)
        zero = jnp.zeros((), jnp.int32)
        return TrainState(
            params=params,
            opt_state=optimizer.init(params),
            dataset=Dataset.empty(config, env.base),
            key=key,
            iteration=zero,
            episodes=zero,
            transitions=zero,
        )

    def iterate(state: TrainState) -> tuple[TrainState, Metrics]:
        task_key, play_key, update_key, key = jax.random.split(state.key, 4)
        tasks, walks = chart(env, sources, task_key, config, shards)
        lesson, metrics = play(agent, config, env, state.params, tasks, walks, play_key, shards)
        state = state._replace(dataset=state.dataset.add(lesson))
        params, opt_state, loss_metrics = optimize(
            agent, config, optimizer, state, update_key, shards
        )
        state = state._replace(
            params=params,
            opt_state=opt_state,
            key=key,
            iteration=state.iteration + 1,
            episodes=state.episodes + config.episodes,
            transitions=state.transitions + jnp.sum(lesson.trajectory.length),
        )
        return state, {**metrics, **loss_metrics}

    return Train(init, iterate, agent, env, config, shards)


def chart(
    env: Environment,
    sources: list[Environment],
    key: jax.Array,
    config: Config,
    shards: Shards = ALONE,
) -> tuple[State, jax.Array]:
    """Draws new tasks, in equal parts from each source, and explores them.

    Returns:
      This device's share of the tasks, M states, and the positions i32[M, T + 1, W] of walks.
    """
    keys = jax.random.split(key, (2, config.tasks))
    share = config.tasks // len(sources)
    drawn = [
        jax.vmap(source.reset)(keys[0, index * share : (index + 1) * share])[0]
        for index, source in enumerate(sources)
    ]
    # Neighbours come from different sources, so that every device gets some of each.
    tasks = jax.tree.map(lambda *x: jnp.stack(x, axis=1).reshape(-1, *x[0].shape[1:]), *drawn)
    tasks, keys = shards.part(tasks), shards.part(keys[1])
    return tasks, jax.lax.map(lambda each: explore(env, each[0], each[1], config), (tasks, keys))


def play(
    agent: Agent,
    config: Config,
    env: Environment,
    params: Params,
    tasks: State,
    walks: jax.Array,
    key: jax.Array,
    shards: Shards = ALONE,
) -> tuple[Lesson, Metrics]:
    """Plays every task many times, from its start and elsewhere, with and without advice.

    The walks go on from where the agent has come to, and its episodes count among them, before
    they say what would have been right.

    Args:
      agent: the network.
      config: the settings.
      env: the dynamics.
      params: the network's parameters.
      tasks: this device's M tasks.
      walks: i32[M, T + 1, W], the walks in them so far.
      key: PRNG key.
      shards: how the tasks are divided over devices.

    Returns:
      The episodes of all devices, neighbours being of the same task, and metrics of play.
    """
    start_key, play_key, walk_key = jax.random.split(key, 3)
    number = config.episodes // config.tasks
    num_restarts = round(config.restarts * number)
    advised = jnp.tile(advised_share(config), config.tasks)
    own_advised = shards.part(advised)
    task = jnp.repeat(jnp.arange(len(walks)), number)

    def starts(atlas: Atlas, key: jax.Array) -> State:
        fresh = jax.tree.map(
            lambda x: jnp.broadcast_to(x, (number - num_restarts, *x.shape)), atlas.task
        )
        known = atlas.sample(key, num_restarts)
        return jax.tree.map(lambda *x: jnp.concatenate(x), fresh, known)

    def judge(atlases: Atlas, states: State) -> tuple[jax.Array, jax.Array]:
        """What is right and known, bool[B, 16], in the states [B] of this device's episodes."""

        def of_one(state: State, task: jax.Array) -> tuple[jax.Array, jax.Array]:
            # Not the atlas of this task alone: vmap would copy it for every episode.
            known = lambda after: atlases.steps[task, position_id(after)]  # noqa: E731
            return look_ahead(env, state, known)

        return jax.vmap(of_one)(states, task)

    def replace(key: jax.Array, states: State, action: jax.Array) -> jax.Array:
        whether_key, which_key = jax.random.split(key)
        whether = shards.part(jax.random.uniform(whether_key, (config.episodes,)))
        noise = shards.part(jax.random.uniform(which_key, (config.episodes, NUM_ACTIONS)))
        right, _ = judge(before, states)
        advice = action_from_index(jnp.argmax(noise * right, axis=1))
        followed = (whether < own_advised) & jnp.any(right, axis=1)
        return jnp.where(followed[:, None], advice, action)

    start_keys = shards.part(jax.random.split(start_key, config.tasks))
    before = jax.lax.map(lambda each: Atlas.of(*each), (tasks, walks))
    initial = jax.lax.map(lambda each: starts(*each), (before, start_keys))
    initial = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), initial)
    trajectory = rollout(
        agent,
        params,
        env,
        initial,
        play_key,
        choose=shards.drawing(sample_action),
        chunk=config.chunk,
        replace=replace,
    )
    walk_keys = shards.part(jax.random.split(walk_key, config.tasks))
    positions, length = _visited(trajectory, len(walks))
    after = jax.lax.map(
        lambda each: go_on(env, *each, config=config),
        (tasks, walks, positions, length, walk_keys),
    )
    right, known = jax.lax.map(
        lambda cells: judge(after, jax.vmap(place)(trajectory.layout, cells)),
        trajectory.cells[:-1],
    )
    right, known = (
        shards.whole(_as_bits(flags) * trajectory.mask.astype(jnp.uint16), axis=1)
        for flags in (right, known)
    )
    first = jax.vmap(position_id)(tasks)
    charted = jnp.take_along_axis(after.steps, first[:, None], axis=1)[:, 0] != UNKNOWN
    charted = shards.whole(charted)
    trajectory = trajectory.gathered(shards)
    alone = advised == 0
    steps = jnp.sum(trajectory.mask)
    metrics = {
        "success": jnp.sum(trajectory.solved & alone) / jnp.sum(alone),
        "episode_length": jnp.sum(trajectory.length * alone) / jnp.sum(alone),
        "charted": jnp.mean(charted.astype(jnp.float32)),
        "labelled": jnp.sum(right != 0) / steps,
    }
    return Lesson(trajectory, right, known), metrics


def go_on(
    env: Environment,
    task: State,
    walks: jax.Array,
    positions: jax.Array,
    length: jax.Array,
    key: jax.Array,
    config: Config,
) -> Atlas:
    """The atlas of a task after the agent's episodes, and walks from where they have been.

    Args:
      env: the dynamics.
      task: the task.
      walks: i32[T + 1, W], the walks so far.
      positions: i32[E, S], of the agent's episodes.
      length: i32[E], their steps.
      key: PRNG key.
      config: the number of walkers, their rounds and the steps of a round.
    """
    if not config.agent_rounds:
        return Atlas.of(task, walks, positions.T)
    keys = jax.random.split(key, 3)
    number = config.agent_rounds * config.walkers
    episode = jax.random.randint(keys[0], (number,), 0, len(positions))
    time = (jax.random.uniform(keys[1], (number,)) * length[episode]).astype(jnp.int32)
    further = walk(env, task, positions[episode, time], keys[2], config.walk_steps)
    return Atlas.of(task, walks, further, positions.T)


def advised_share(config: Config) -> jax.Array:
    """f32[episodes of a task]: the share of steps on which advice is followed, by episode.

    The first, a share of `1 - config.advised`, follow none; from there on it rises to
    `config.advice`.
    """
    number = config.episodes // config.tasks
    alone = max(round((1 - config.advised) * number), 1)
    rank = jnp.maximum(jnp.arange(number) - (alone - 1), 0)
    return config.advice * rank / max(number - alone, 1)


def optimize(
    agent: Agent,
    config: Config,
    optimizer: optax.GradientTransformation,
    state: TrainState,
    key: jax.Array,
    shards: Shards = ALONE,
) -> tuple[Params, Any, Metrics]:
    """Gradient steps on minibatches of episodes drawn from the dataset, or their images."""
    num_steps = config.epochs * config.episodes // config.minibatch
    episode_key, symmetry_key = jax.random.split(key)
    drawn = jax.random.randint(episode_key, (num_steps, config.minibatch), 0, state.dataset.number)
    symmetries = jax.random.randint(symmetry_key, (num_steps,), 0, NUM_SYMMETRIES)

    def update(
        carry: tuple[Params, Any], minibatch: tuple[jax.Array, jax.Array]
    ) -> tuple[tuple[Params, Any], Metrics]:
        params, opt_state = carry
        episodes, symmetry = minibatch
        steps = jnp.maximum(jnp.sum(state.dataset.right[:, episodes] != 0), 1)
        own = state.dataset.take(shards.part(episodes))
        if config.mirrored:
            own = own.mirrored(Symmetry.of(symmetry))
        gradient, metrics = shards.mean(
            jax.grad(loss, has_aux=True)(params, agent, config, own, steps / shards.count)
        )
        updates, opt_state = optimizer.update(gradient, opt_state, params)
        updates = jax.tree.map(lambda update: rate * update, updates)
        metrics["gradient_norm"] = optax.tree.norm(gradient)
        params: Any = optax.apply_updates(params, updates)
        return (params, opt_state), metrics

    rate = cooldown(config, state.iteration)
    (params, opt_state), metrics = jax.lax.scan(
        update, (state.params, state.opt_state), (drawn, symmetries)
    )
    return params, opt_state, jax.tree.map(jnp.mean, metrics)


def loss(
    params: Params, agent: Agent, config: Config, batch: Dataset, steps: jax.Array
) -> tuple[jax.Array, Metrics]:
    """Minus the log-probability of doing something right, a mean over steps with advice.

      - 1 / steps * sum over steps of log (pi(right | o_1 .. o_t) / pi(known | o_1 .. o_t))

    Actions of which nothing is known are left out: they need not be wrong.

    Args:
      params: the parameters.
      agent: the network.
      config: the settings.
      batch: episodes.
      steps: f32[], what to divide the sum over steps by.

    Returns:
      f32[], and sums over steps, divided likewise: the loss, the probability of doing
      something right, and the entropy.
    """
    observation_id = observation_ids(batch.layout, batch.cells)
    features = encode_episodes(params, agent, config, observation_id, batch.layout, batch.cells)
    reward = jnp.zeros(batch.right.shape)  # it comes with the end only
    embedding = agent.unroll(params, features, batch.action.astype(jnp.int32), reward)
    outputs = agent.act(params, embedding)
    joint = joint_log_probs(outputs)
    right, known = (
        jax.nn.logsumexp(jnp.where(_from_bits(bits), joint, IMPOSSIBLE), axis=-1)
        for bits in (batch.right, batch.known)
    )
    log_prob = right - known
    entropy = losses.entropy(outputs.grasp_logits) + losses.entropy(outputs.move_logits)

    def mean(x: jax.Array) -> jax.Array:
        return jnp.sum(jnp.where(batch.right != 0, x, 0.0)) / steps

    total = -mean(log_prob)
    return total, {"loss": total, "right": mean(jnp.exp(log_prob)), "entropy": mean(entropy)}


def joint_log_probs(outputs: Outputs) -> jax.Array:
    """The log-probabilities f32[..., 16] of all actions, by `action_to_index`."""
    grasp, move = jax.nn.log_softmax(outputs.grasp_logits), jax.nn.log_softmax(outputs.move_logits)
    joint = grasp[..., :, None] + move[..., None, :]
    return joint.reshape(*joint.shape[:-2], NUM_ACTIONS)


def _as_bits(flags: jax.Array) -> jax.Array:
    """bool[..., 16] to u16[...]."""
    weights = (1 << ACTIONS).reshape((1,) * (flags.ndim - 1) + (-1,))
    return jnp.sum(flags * weights, axis=-1).astype(jnp.uint16)


def _from_bits(bits: jax.Array) -> jax.Array:
    """u16[...] to bool[..., 16]."""
    shifts = ACTIONS.astype(np.uint16).reshape((1,) * bits.ndim + (-1,))
    return (bits[..., None] >> shifts) % 2 == 1


def _visited(trajectory: Trajectory, num_tasks: int) -> tuple[jax.Array, jax.Array]:
    """The positions i32[M, E, T + 1] of the episodes of each task, and their lengths i32[M, E]."""
    one_time = jax.vmap(lambda layout, cells: position_id(place(layout, cells)))
    positions = jax.vmap(one_time, in_axes=(None, 0))(trajectory.layout, trajectory.cells)
    positions = positions.T.reshape(num_tasks, -1, len(positions))
    return positions, trajectory.length.reshape(num_tasks, -1)
