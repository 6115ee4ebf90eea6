"""Time of a training iteration by part: `python -m benchmarks.train_throughput`.

Times a whole iteration, then rollout, encoder and recurrent part by themselves on the same
episodes. The parts are separate programs, so their times add up to the iteration only roughly.
Useful arithmetic is compared with a large matrix product.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import tyro
from jax.extend.core import ClosedJaxpr, Jaxpr
from rich.console import Console
from rich.table import Table

from agents import Config, make_train
from agents.acting.encodings import encode_episodes
from agents.acting.episodes import take
from agents.acting.rollout import Trajectory
from agents.config import PRESETS
from agents.curiosity import Experience
from agents.networks.agent import Params
from agents.ppo.learner import Batch, Learner, TrainState
from benchmarks import harness
from trap_tube_jax import task_set
from trap_tube_jax.checks import check_integer
from trap_tube_jax.command_line import plain_errors

MATRIX_SIZE = 4096


@dataclasses.dataclass(frozen=True)
class Options(harness.Options):
    """Options of this benchmark.

    Attributes:
      preset: settings of training.
      sets: task sets to train on, by id or short name.
      warm: iterations of training before the measurement.
    """

    preset: Annotated[str, tyro.conf.arg(metavar="|".join(PRESETS))] = "paper"
    sets: tuple[str, ...] = ("base", "pstsy")
    warm: int = 0

    def check(self) -> None:
        """Checks the options; see `harness.Options.check`."""
        check_integer("warm", self.warm, minimum=0)
        super().check()


@dataclasses.dataclass(frozen=True)
class Part:
    """A part of the iteration, or all of it.

    Attributes:
      task_set: short name of the task set.
      name: name of the part.
      steps_per_s: environment steps of the iteration, per second of this part.
      flop: useful floating-point operations: matrix products alone, without padding or anything
        computed again. The encoder counts each distinct observation of a minibatch; GRU and heads
        count each step taken, twice where the curiosity needs the output after the step.
      timing: seconds of the part in one iteration.
    """

    task_set: str
    name: str
    steps_per_s: float
    flop: float
    timing: harness.Timing

    @property
    def flops(self) -> float:
        """Useful operations per second."""
        return self.flop / self.timing.median_s


class Flop(NamedTuple):
    """Useful operations of an iteration.

    Attributes:
      play: operations of the rollout.
      encode: operations of the encoder in all gradient steps.
      core: operations of GRU and heads in all gradient steps.
    """

    play: float
    encode: float
    core: float


def measure(config: Config, *, warm: int, repeats: int) -> list[Part]:
    """Measures the iteration and its parts after `warm` iterations of training."""
    learner = make_train(config)
    state = jax.jit(learner.init)(jax.random.key(0))
    iterate = jax.jit(learner.iterate)
    for _ in range(warm):
        state, _ = iterate(state)
    reset_key, action_key = jax.random.split(state.key)
    reset_keys = jax.random.split(reset_key, config.episodes_per_iteration)

    def play(state: TrainState) -> Trajectory:
        return learner.play(state.params, reset_keys, action_key)

    trajectory = jax.jit(play)(state)
    rewards, _ = jax.jit(learner.intrinsic_reward)(state, trajectory)
    batch, _ = jax.jit(learner.make_batch)(state, trajectory, rewards)
    params, features = state.params, trajectory.features
    flop = useful_flop(learner, state, batch)
    encoder = functools.partial(encoder_gradients, learner)
    core = functools.partial(core_gradients, learner)
    parts: list[tuple[str, float, Callable[..., Any], tuple[Any, ...]]] = [
        ("iteration", sum(flop), learner.iterate, (state,)),
        ("rollout", flop.play, play, (state,)),
        ("encoder", flop.encode, encoder, (params, batch)),
        ("recurrent part and heads", flop.core, core, (params, batch, features)),
    ]
    short = task_set(config.env_id).short
    steps = float(jnp.sum(batch.episodes.mask))
    results = []
    for name, useful, function, arguments in parts:
        timing = harness.measure(function, *arguments, repeats=repeats)
        results.append(Part(short, name, steps / timing.median_s, useful, timing))
    return results


def encoder_gradients(learner: Learner, params: Params, batch: Batch) -> Params:
    """Sums the encoder's gradients over all minibatches, for some loss of its features."""

    def loss(params: Params, part: Batch) -> jax.Array:
        features = encode_episodes(
            learner.agent.encode_rows,
            {"encoder": params["encoder"]},
            part.episodes,
            chunk=learner.config.encode_chunk_size,
        )
        return jnp.sum(features * jnp.cos(jnp.arange(features.shape[-1]))[None, None])

    def gradient(places: jax.Array) -> Params:
        return jax.grad(loss)(params, take(batch, places))

    return _sum_over_minibatches(learner.config, gradient, params)


def core_gradients(learner: Learner, params: Params, batch: Batch, features: jax.Array) -> Params:
    """Sums the gradients of GRU, heads and curiosity, from features f32[T + 1, B, F]."""

    def gradient(places: jax.Array) -> Params:
        by_params, by_features = jax.grad(_core_loss, (1, 2))(
            learner, params, features[:, places], take(batch, places)
        )
        # The derivative by the features is part of the work, so something must need it.
        return jax.tree.map(lambda x: x + 1e-30 * jnp.sum(by_features), by_params)

    return _sum_over_minibatches(learner.config, gradient, params)


def _core_loss(learner: Learner, params: Params, features: jax.Array, part: Batch) -> jax.Array:
    """Returns the sum of squares of everything that the loss terms are computed from."""
    agent, curiosity = learner.agent, learner.curiosity
    episodes, both = part.episodes, curiosity.needs_next_embedding
    embedding, following = agent.unroll(
        params, features, episodes.action, episodes.reward, both=both
    )
    own = {}
    if both:
        actions = agent.embed_action(params, episodes.action)
        experience = Experience(episodes, features[..., :0], embedding, following, actions)
        own = curiosity.losses(params["curiosity"], experience)
    everything = jax.tree.leaves((agent.policy_and_value(params, embedding), own))
    return sum((jnp.sum(jnp.square(x)) for x in everything), jnp.zeros(()))


def _minibatches(config: Config) -> jax.Array:
    """Draws the episodes i32[gradient steps, minibatch_size] of all gradient steps."""
    keys = jax.random.split(jax.random.key(0), config.epochs)
    orders = jax.vmap(lambda key: jax.random.permutation(key, config.episodes_per_iteration))(keys)
    return orders.reshape(-1, config.minibatch_size)


def _sum_over_minibatches(
    config: Config, gradient: Callable[[jax.Array], Params], params: Params
) -> Params:
    def add(total: Params, places: jax.Array) -> tuple[Params, None]:
        return jax.tree.map(jnp.add, total, gradient(places)), None

    zero = jax.tree.map(jnp.zeros_like, params)
    return jax.lax.scan(add, zero, _minibatches(config))[0]


def useful_flop(learner: Learner, state: TrainState, batch: Batch) -> Flop:
    """Counts the useful operations of an iteration with these episodes; see `Part`."""
    config, agent = learner.config, learner.agent

    def step(params: Params, features: jax.Array) -> Any:
        action, reward = jnp.zeros((1, 2), jnp.int32), jnp.zeros(1)
        first = agent.initial_state(params, 1)
        return agent.policy_and_value(params, agent.step(params, first, features, action, reward))

    board = batch.episodes.observations()[0, :1]
    per_observation = matrix_flop(jax.make_jaxpr(agent.encode)(state.params, board))
    features = agent.encode(state.params, board)
    per_step = matrix_flop(jax.make_jaxpr(step)(state.params, features))
    distinct = float(jax.jit(lambda batch: _distinct_per_epoch(config, batch))(batch))
    steps = float(jnp.sum(batch.episodes.mask))
    outputs = 2 if learner.curiosity.needs_next_embedding else 1
    passes = 3 * config.epochs  # one forward, and one each for the derivatives by input and kernel
    return Flop(
        play=per_observation * float(jnp.max(batch.episodes.observation_id) + 1) + per_step * steps,
        encode=passes * per_observation * distinct,
        core=passes * outputs * per_step * steps,
    )


def _distinct_per_epoch(config: Config, batch: Batch) -> jax.Array:
    """Returns the mean over epochs of the minibatches' distinct observations, summed, f32[]."""

    def count(places: jax.Array) -> jax.Array:
        ids = jnp.sort(batch.episodes.observation_id[:, places].reshape(-1))
        return 1 + jnp.sum(ids[1:] != ids[:-1])

    return jnp.sum(jax.lax.map(count, _minibatches(config))) / config.epochs


def matrix_flop(jaxpr: ClosedJaxpr | Jaxpr) -> float:
    """Counts the operations of all matrix products in a jaxpr; the body of a loop counts once."""
    inner = jaxpr.jaxpr if isinstance(jaxpr, ClosedJaxpr) else jaxpr
    total = 0.0
    for equation in inner.eqns:
        if equation.primitive.name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            operand: Any = equation.invars[0].aval
            result: Any = equation.outvars[0].aval
            depth = math.prod(operand.shape[axis] for axis in contracted)
            total += 2.0 * depth * math.prod(result.shape)
        for value in equation.params.values():
            if isinstance(value, ClosedJaxpr | Jaxpr):
                total += matrix_flop(value)
    return total


def matrix_product_flops() -> float:
    """Returns the operations per second of a large float32 matrix product."""
    matrix = jnp.ones((MATRIX_SIZE, MATRIX_SIZE))
    return 2.0 * MATRIX_SIZE**3 / harness.measure(jnp.matmul, matrix, matrix).median_s


def main(options: Options) -> list[Part]:
    """Measures, prints a table and writes the record."""
    options.check()
    configs = [Config.preset(options.preset, env_id=task_set(each).id) for each in options.sets]
    console = Console()
    console.print(harness.machine())
    peak = matrix_product_flops()
    console.print(f"matrix product {MATRIX_SIZE} x {MATRIX_SIZE}: {peak / 1e9:.0f} GFLOP/s")
    columns = ("set", "part", "seconds", "steps/s", "compile, s", "useful GFLOP/s", "of peak")
    table = Table(*columns, title=f"preset {options.preset}")
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
            f"{part.flops / 1e9:.0f}",
            f"{part.flops / peak:.0%}",
        )
    console.print(table)
    harness.write_record("train_throughput", options, results, matrix_product_flops=peak)
    return results


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Options, description=__doc__))
