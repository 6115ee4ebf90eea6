"""Where the time of one training iteration goes: `python -m benchmarks.train_throughput`.

Times a whole iteration, then its parts by themselves on the same episodes, and compares the
useful arithmetic of encoder and recurrent part, which is nearly all there is, with a large matrix
product. The parts are separate programs, so they add up to the iteration only roughly.
"""

import dataclasses
import math
import pathlib
from collections.abc import Callable
from typing import Any, NamedTuple

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
from agents.curiosity import Experience
from agents.networks.agent import Params
from agents.ppo.learner import Batch, Learner, TrainState
from benchmarks import harness
from trap_tube_jax import task_set
from trap_tube_jax.checks import check_integer
from trap_tube_jax.command_line import plain_errors

MATRIX = 4096


@dataclasses.dataclass(frozen=True)
class Arguments:
    """What to measure.

    Attributes:
      preset: the settings, those of `agents.train`.
      env: task sets to train on, by id or short name.
      warm: iterations of training before the clock starts.
      repeats: timed calls; the median counts.
      json: file to write the record to; refused unless all is of committed code.
    """

    preset: str = "paper"
    env: tuple[str, ...] = ("base", "pstsy")
    warm: int = 0
    repeats: int = 3
    json: pathlib.Path | None = None


@dataclasses.dataclass(frozen=True)
class Part:
    """A part of the iteration, or all of it.

    Attributes:
      env: short name of the task set.
      name: what is timed.
      timing: of one iteration's worth of it.
      flop: useful floating-point operations of matrix products in it. The encoder's: each distinct
        observation whole, once per minibatch and derivative, nothing recomputed, no padding.
        Windows that observations share count in each, though they are encoded once. Those of GRU
        and heads: each step that was taken, once per epoch and derivative; twice where the
        curiosity needs the GRU's output after the step.
    """

    env: str
    name: str
    timing: harness.Timing
    flop: float

    @property
    def flops(self) -> float:
        """Useful operations per second."""
        return self.flop / self.timing.median_s


class Flop(NamedTuple):
    """Useful operations of an iteration.

    Attributes:
      play: of the rollout.
      encode: of the encoder in all gradient steps.
      core: of GRU and heads in all gradient steps.
    """

    play: float
    encode: float
    core: float


def measure(config: Config, *, warm: int, repeats: int) -> list[Part]:
    """The iteration and its parts; see `Arguments`."""
    train = make_train(config)
    state = jax.jit(train.init)(jax.random.key(0))
    iterate = jax.jit(train.iterate)
    for _ in range(warm):
        state, _ = iterate(state)
    reset_key, action_key = jax.random.split(state.key)
    reset_keys = jax.random.split(reset_key, config.episodes_per_iteration)

    def play(train: Learner, state: TrainState) -> Trajectory:
        return train.play(state.params, reset_keys, action_key)

    trajectory = _jitted(play, train, state)()
    rewards, _ = jax.jit(train.intrinsic_reward)(state, trajectory)
    batch, _ = jax.jit(train.make_batch)(state, trajectory, rewards)
    flop = useful_flop(train, state, batch)
    parts: list[tuple[str, Callable[[], Any], float]] = [
        ("iteration", _jitted(Learner.iterate, train, state), sum(flop)),
        ("rollout", _jitted(play, train, state), flop.play),
        ("encoder", _jitted(_encoder_only, train, state, batch), flop.encode),
        (
            "recurrent part and heads",
            _jitted(_core_only, train, state, batch, trajectory),
            flop.core,
        ),
        ("optimiser", _jitted(_optimizer_only, train, state), 0.0),
    ]
    short = task_set(config.env_id).short
    return [Part(short, name, harness.measure(run, repeats), flop) for name, run, flop in parts]


def useful_flop(train: Learner, state: TrainState, batch: Batch) -> Flop:
    """The useful operations of an iteration with these episodes; see `Part`."""
    config, agent = train.config, train.agent

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
    outputs = 2 if train.curiosity.needs_embeddings else 1
    # One pass forward, and one each for the derivatives by inputs and by kernels.
    passes = 3 * config.epochs
    return Flop(
        play=per_observation * float(jnp.max(batch.observation_id) + 1) + per_step * steps,
        encode=passes * per_observation * distinct,
        core=passes * outputs * per_step * steps,
    )


def matrix_flop(jaxpr: ClosedJaxpr | Jaxpr) -> float:
    """Floating-point operations of all matrix products in a function's jaxpr.

    The body of a loop counts once.
    """
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
    """Floating-point operations per second of a large float32 matrix product."""
    matrix = jnp.ones((MATRIX, MATRIX))
    multiply = jax.jit(jnp.matmul)
    timing = harness.measure(lambda: multiply(matrix, matrix))
    return 2.0 * MATRIX**3 / timing.median_s


def _minibatches(config: Config) -> jax.Array:
    """i32[epochs * minibatches, minibatch]: episodes, shuffled anew in each epoch."""
    keys = jax.random.split(jax.random.key(0), config.epochs)
    orders = jax.vmap(lambda key: jax.random.permutation(key, config.episodes_per_iteration))(keys)
    return orders.reshape(-1, config.minibatch_size)


def _distinct_per_epoch(config: Config, batch: Batch) -> jax.Array:
    """f32[]: distinct observations summed over an epoch's minibatches, on average."""

    def count(episodes: jax.Array) -> jax.Array:
        names = jnp.sort(batch.observation_id[:, episodes].reshape(-1))
        return 1 + jnp.sum(names[1:] != names[:-1])

    return jnp.sum(jax.lax.map(count, _minibatches(config))) / config.epochs


def _accumulate(config: Config, gradient: Callable[[jax.Array], Params], params: Params) -> Params:
    """The sum of a gradient over all minibatches of all epochs."""

    def add(total: Params, episodes: jax.Array) -> tuple[Params, None]:
        return jax.tree.map(jnp.add, total, gradient(episodes)), None

    zero = jax.tree.map(jnp.zeros_like, params)
    return jax.lax.scan(add, zero, _minibatches(config))[0]


def _encoder_only(train: Learner, state: TrainState, batch: Batch) -> Params:
    def total(params: Params, part: Batch) -> jax.Array:
        features = encode_episodes(
            train.agent.encode_rows,
            {"encoder": params["encoder"]},
            part.episodes,
            part.observation_id,
            chunk=train.config.encode_chunk_size,
        )
        return jnp.sum(features * jnp.cos(jnp.arange(features.shape[-1]))[None, None])

    return _accumulate(
        train.config,
        lambda episodes: jax.grad(total)(state.params, take(batch, episodes)),
        state.params,
    )


def _core_only(train: Learner, state: TrainState, batch: Batch, trajectory: Trajectory) -> Params:
    agent = train.agent

    def total(params: Params, features: jax.Array, part: Batch) -> jax.Array:
        given = (params, features, part.episodes.action, part.episodes.reward)
        if train.curiosity.needs_embeddings:
            embedding, following = agent.unroll_both(*given)
            experience = Experience(
                part.episodes,
                part.observation_id,
                features[..., :0],
                embedding,
                following,
                agent.embed_action(params, part.episodes.action),
            )
            own = train.curiosity.losses(params["curiosity"], experience)
        else:
            embedding, own = agent.unroll(*given), {}
        everything = jax.tree.leaves((agent.policy_and_value(params, embedding), own))
        return sum((jnp.sum(jnp.square(x)) for x in everything), jnp.zeros(()))

    def gradient(episodes: jax.Array) -> Params:
        features = trajectory.features[:, episodes]
        by_params, by_features = jax.grad(total, (0, 1))(
            state.params, features, take(batch, episodes)
        )
        # The derivative by the features is part of the work, so something must need it.
        return jax.tree.map(lambda x: x + 1e-30 * jnp.sum(by_features), by_params)

    return _accumulate(train.config, gradient, state.params)


def _optimizer_only(train: Learner, state: TrainState) -> Params:
    optimizer = train.optimizer

    def update(carry: Any, _: jax.Array) -> tuple[Any, None]:
        params, opt_state = carry
        updates, opt_state = optimizer.update(params, opt_state, params)
        return (jax.tree.map(jnp.add, params, updates), opt_state), None

    steps = train.config.epochs * (
        train.config.episodes_per_iteration // train.config.minibatch_size
    )
    return jax.lax.scan(update, (state.params, state.opt_state), jnp.arange(steps))[0][0]


def _jitted(function: Callable[..., Any], train: Learner, *arrays: Any) -> Callable[[], Any]:
    """A program of its own, which its first call compiles, whatever has been compiled before."""
    compiled = jax.jit(lambda *x: function(train, *x))
    return lambda: compiled(*arrays)


def main(arguments: Arguments) -> list[Part]:
    """Measures, prints a table, and writes JSON if asked to."""
    check_integer("warm", arguments.warm, minimum=0)
    check_integer("repeats", arguments.repeats)
    configs = [Config.preset(arguments.preset, env_id=task_set(env).id) for env in arguments.env]
    harness.check_recordable(arguments.json)
    console = Console()
    console.print(harness.machine())
    peak = matrix_product_flops()
    console.print(f"matrix product {MATRIX} x {MATRIX}: {peak / 1e9:.0f} GFLOP/s")
    columns = ("set", "part", "seconds", "share", "compile, s", "useful GFLOP/s", "of peak")
    table = Table(*columns, title=f"preset {arguments.preset}")
    results: list[Part] = []
    for config in configs:
        parts = measure(config, warm=arguments.warm, repeats=arguments.repeats)
        results += parts
        for part in parts:
            table.add_row(
                part.env,
                part.name,
                f"{part.timing.median_s:.2f}",
                f"{part.timing.median_s / parts[0].timing.median_s:.0%}",
                f"{part.timing.compile_s:.1f}",
                f"{part.flops / 1e9:.0f}" if part.flop else "",
                f"{part.flops / peak:.0%}" if part.flop else "",
            )
    console.print(table)
    if arguments.json is not None:
        harness.write_record(
            arguments.json,
            "train_throughput",
            arguments,
            results,
            preset=arguments.preset,
            warm=arguments.warm,
            matrix_product_flops=peak,
        )
    return results


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Arguments, description=__doc__))
