"""Time of a training iteration by part: `python -m benchmarks.train_throughput`.

Times a whole iteration, then rollout, encoder and recurrent part by themselves on the same
episodes. The parts are separate programs, so their times add up to the iteration only roughly.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from rich.table import Table

import trap_tube_jax as tt
from agents import Config, make_learner
from agents.acting.episodes import Episodes
from agents.acting.rollout import Trajectory
from agents.curiosity import Experience
from agents.networks.agent import Params
from agents.ppo.learner import Batch, Learner, TrainState
from benchmarks import harness
from trap_tube_jax.state import take


@dataclasses.dataclass(frozen=True)
class Options(harness.Options):
    """Times a training iteration and its parts.

    Attributes:
      preset: settings of training, a name of `agents.config.PRESETS`.
      sets: task sets to train on, by id or short name.
      warm: iterations of training before the measurement.
    """

    preset: str = "paper"
    sets: tuple[str, ...] = ("base", "pstsy")
    warm: int = 0


@dataclasses.dataclass(frozen=True)
class Part:
    """A part of the iteration, or all of it.

    Attributes:
      task_set: short name of the task set.
      name: name of the part.
      steps_per_s: environment steps of the iteration, per second of this part.
      timing: seconds of the part in one iteration.
    """

    task_set: str
    name: str
    steps_per_s: float
    timing: harness.Timing


def measure(config: Config, *, warm: int, repeats: int) -> list[Part]:
    """Measures the iteration and its parts after `warm` iterations of training."""
    learner = make_learner(config)
    state = jax.jit(learner.init)(jax.random.key(0))
    iterate = jax.jit(learner.iterate)
    for _ in range(warm):
        state, _ = iterate(state)
    reset_key, action_key, *_ = jax.random.split(state.key, 4)  # as `Learner.iterate` does
    reset_keys = learner.draw_tasks(state.task_replay, reset_key)

    def play(state: TrainState) -> Trajectory:
        return learner.play(state.params, reset_keys, action_key)

    trajectory = jax.jit(play)(state)
    rewards, _ = jax.jit(learner.intrinsic_reward)(state, trajectory)
    batch, _ = jax.jit(learner.make_batch)(state, trajectory, rewards)
    params = state.params
    features = jax.jit(functools.partial(encode, learner))(params, batch.episodes)
    encoder = functools.partial(encoder_gradients, learner)
    core = functools.partial(core_gradients, learner)
    parts: list[tuple[str, Callable[..., Any], tuple[Any, ...]]] = [
        ("iteration", learner.iterate, (state,)),
        ("rollout", play, (state,)),
        ("encoder", encoder, (params, batch)),
        ("recurrent part and heads", core, (params, batch, features)),
    ]
    short = tt.task_set(config.env_id).short
    steps = float(jnp.sum(batch.episodes.mask))
    results = []
    for name, function, arguments in parts:
        timing = harness.measure(function, *arguments, repeats=repeats)
        results.append(Part(short, name, steps / timing.median_s, timing))
    return results


def encode(learner: Learner, params: Params, episodes: Episodes) -> jax.Array:
    """Encodes all observations of episodes to f32[B, T + 1, F], for the policy alone."""
    return learner.encoding.encode_episodes(params, episodes)[0]


def encoder_gradients(learner: Learner, params: Params, batch: Batch) -> Params:
    """Sums the encoder's gradients over all minibatches, for some loss of its features."""

    def loss(params: Params, part: Batch) -> jax.Array:
        features = encode(learner, params, part.episodes)
        return jnp.sum(features * jnp.cos(jnp.arange(features.shape[-1]))[None, None])

    def gradient(index: jax.Array) -> Params:
        return jax.grad(loss)(params, take(batch, index))

    return _sum_over_minibatches(learner.config, gradient, params)


def core_gradients(learner: Learner, params: Params, batch: Batch, features: jax.Array) -> Params:
    """Sums the gradients of GRU, heads and curiosity, from features f32[B, T + 1, F]."""

    def gradient(index: jax.Array) -> Params:
        by_params, by_features = jax.grad(_core_loss, (1, 2))(
            learner, params, features[index], take(batch, index)
        )
        # The gradient with respect to the features is part of the work, so the result must depend
        # on it.
        return jax.tree.map(lambda x: x + 1e-30 * jnp.sum(by_features), by_params)

    return _sum_over_minibatches(learner.config, gradient, params)


def _core_loss(learner: Learner, params: Params, features: jax.Array, part: Batch) -> jax.Array:
    """Returns the sum of squares of what all loss terms but motion's are computed from."""
    agent = learner.agent
    curiosity = learner.curiosity
    episodes = part.episodes
    hidden, next_hidden = agent.unroll(
        params,
        features,
        episodes.action,
        episodes.reward,
        with_next=curiosity.needs_next_hidden,
    )
    actions = agent.embed_action(params, episodes.action)
    experience = Experience(episodes, features[..., :0], hidden, next_hidden, actions)
    curiosity_losses = curiosity.losses(params["curiosity"], experience)
    everything = jax.tree.leaves((agent.policy_and_value(params, hidden), curiosity_losses))
    return sum((jnp.sum(jnp.square(x)) for x in everything), jnp.zeros(()))


def _minibatches(config: Config) -> jax.Array:
    """Draws the episodes i32[gradient steps, minibatch_size] of all gradient steps."""
    keys = jax.random.split(jax.random.key(0), config.epochs)
    orders = jax.vmap(lambda key: jax.random.permutation(key, config.episodes_per_iteration))(keys)
    return orders.reshape(-1, config.minibatch_size)


def _sum_over_minibatches(
    config: Config, gradient: Callable[[jax.Array], Params], params: Params
) -> Params:
    def add(total: Params, index: jax.Array) -> tuple[Params, None]:
        return jax.tree.map(jnp.add, total, gradient(index)), None

    zero = jax.tree.map(jnp.zeros_like, params)
    return jax.lax.scan(add, zero, _minibatches(config))[0]


def main(options: Options) -> list[Part]:
    """Measures, prints a table and writes the record."""
    configs = [Config.preset(options.preset, env_id=tt.task_set(each).id) for each in options.sets]
    console = harness.begin(options)
    table = Table(
        "set", "part", "seconds", "steps/s", "compile, s", title=f"preset {options.preset}"
    )
    results: list[Part] = []
    for config in configs:
        results += measure(config, warm=options.warm, repeats=options.repeats)
    for part in results:
        table.add_row(
            part.task_set,
            part.name,
            f"{part.timing.median_s:.2f}",
            f"{part.steps_per_s:,.0f}",
            f"{part.timing.compile_s:.1f}",
        )
    console.print(table)
    harness.write_record("train_throughput", options, results)
    return results


if __name__ == "__main__":
    harness.run(main, Options, "train_throughput")
