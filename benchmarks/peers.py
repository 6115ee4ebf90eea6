"""This environment and other JAX gridworlds: `python -m benchmarks.peers`.

All environments run in one process, take random actions and reset automatically, and every byte of
every observation is consumed, as in a user's program. The extra `[bench]` installs the peers. A
peer that cannot be imported or fails is skipped, and the reason is printed.
"""

import dataclasses
import importlib
import itertools
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
from rich.table import Table

from benchmarks import env_throughput, harness
from benchmarks.env_throughput import StepOptions, Subject, Throughput


def gymnax_breakout() -> Subject:
    """Returns gymnax's MinAtar Breakout, whose step resets automatically and takes a key."""
    env, params = importlib.import_module("gymnax").make("Breakout-MinAtar")

    def reset(keys: jax.Array) -> Any:
        observation, state = jax.vmap(env.reset, (0, None))(keys, params)
        return (state, keys[0]), observation

    def step(carry: Any, actions: jax.Array) -> Any:
        state, key = carry
        key, step_keys = _split(key, len(actions))
        observation, state, *_ = jax.vmap(env.step, (0, 0, 0, None))(
            step_keys, state, actions, params
        )
        return (state, key), observation

    return Subject("gymnax Breakout", reset, step, _actions(env.num_actions))


def pgx_breakout() -> Subject:
    """Returns MinAtar Breakout of pgx under its own auto-reset, which takes a key."""
    env = importlib.import_module("pgx").make("minatar-breakout")
    auto_step = importlib.import_module("pgx.experimental").auto_reset(env.step, env.init)

    def reset(keys: jax.Array) -> Any:
        state = jax.vmap(env.init)(keys)
        return (state, keys[0]), state.observation

    def step(carry: Any, actions: jax.Array) -> Any:
        state, key = carry
        key, step_keys = _split(key, len(actions))
        state = jax.vmap(auto_step)(state, actions, step_keys)
        return (state, key), state.observation

    return Subject("pgx Breakout", reset, step, _actions(env.num_actions))


def navix_doorkey() -> Subject:
    """Returns Navix's DoorKey-8x8, which resets automatically."""
    env = importlib.import_module("navix").make("Navix-DoorKey-8x8-v0")
    reset = jax.vmap(env.reset)
    step = jax.vmap(env.step)
    return _stateless("Navix DoorKey-8x8", reset, step, len(env.action_set))


def xland_doorkey() -> Subject:
    """Returns DoorKey-8x8 of XLand-MiniGrid under its own auto-reset."""
    env, params = importlib.import_module("xminigrid").make("MiniGrid-DoorKey-8x8")
    env = importlib.import_module("xminigrid.wrappers").GymAutoResetWrapper(env)

    def reset(keys: jax.Array) -> Any:
        return jax.vmap(env.reset, (None, 0))(params, keys)

    def step(timestep: Any, actions: jax.Array) -> Any:
        return jax.vmap(env.step, (None, 0, 0))(params, timestep, actions)

    return _stateless("XLand DoorKey-8x8", reset, step, env.num_actions(params))


def jumanji_snake() -> Subject:
    """Returns Snake of Jumanji under its own auto-reset."""
    env = importlib.import_module("jumanji").make("Snake-v1")
    env = importlib.import_module("jumanji.wrappers").AutoResetWrapper(env)
    reset = jax.vmap(env.reset)
    step = jax.vmap(env.step)
    return Subject(
        "Jumanji Snake", reset, step, _actions(4), lambda timestep: timestep.observation.grid
    )


PeerName = Literal["gymnax", "pgx", "navix", "xminigrid", "jumanji"]
PEERS: dict[PeerName, Callable[[], Subject]] = {
    "gymnax": gymnax_breakout,
    "pgx": pgx_breakout,
    "navix": navix_doorkey,
    "xminigrid": xland_doorkey,
    "jumanji": jumanji_snake,
}
INSTALL = " (pip install -e '.[bench]')"


@dataclasses.dataclass(frozen=True)
class Options(StepOptions):
    """Measures steps per second of the task sets and of other JAX gridworlds.

    Attributes:
      peers: the libraries to compare with.
    """

    peers: tuple[PeerName, ...] = tuple(PEERS)


def measure(
    options: Options, subjects: Sequence[Subject]
) -> tuple[list[Throughput], dict[str, str]]:
    """Measures our task sets and the peers; returns results, and reasons by what was skipped."""
    pairs = itertools.product(subjects, options.num_envs)
    results = [env_throughput.measure_throughput(*pair, options) for pair in pairs]
    skipped = {}
    for name, num_envs in itertools.product(options.peers, options.num_envs):
        try:
            results.append(env_throughput.measure_throughput(PEERS[name](), num_envs, options))
        except Exception as error:  # a broken peer, or one out of memory, must not break the others
            first_line = next(iter(str(error).splitlines()), "")
            hint = INSTALL if isinstance(error, ImportError) else ""
            skipped[f"{name}, {num_envs:,} envs"] = f"{type(error).__name__}: {first_line}{hint}"
    return results, skipped


def main(options: Options) -> None:
    """Measures, prints a table and the skipped peers, and writes the record."""
    console = harness.begin(options)
    subjects = [env_throughput.task_set_subject(name) for name in options.sets]
    results, skipped = measure(options, subjects)
    first = {result.num_envs: result.steps_per_s for result in reversed(results)}
    columns = ("envs", "M steps/s", "ratio", "µs/step", "B/obs.", "GB/s")
    table = Table("subject", *columns, "compile, s")
    for result in sorted(results, key=lambda result: result.num_envs):
        table.add_row(
            result.name,
            f"{result.num_envs:,}",
            f"{result.steps_per_s / 1e6:.2f}",
            f"{first[result.num_envs] / result.steps_per_s:.1f}",
            f"{1e6 / result.steps_per_s:.3f}",
            f"{result.observation_bytes}",
            f"{result.bytes_per_s / 1e9:.2f}",
            f"{result.timing.compile_s:.1f}",
        )
    console.print(table)
    console.print("ratio: speed of the first subject over this one; µs of one environment's step")
    for name, reason in skipped.items():
        console.print(f"skipped {name}: {reason}", markup=False)
    harness.write_record("peers", options, results, skipped=skipped)


def _stateless(
    name: str, reset: Callable[..., Any], step: Callable[..., Any], num_actions: int
) -> Subject:
    """Returns a subject whose timestep is its whole state."""

    def twice(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            timestep = function(*arguments)
            return timestep, timestep.observation

        return call

    return Subject(name, twice(reset), twice(step), _actions(num_actions))


def _actions(num_actions: int) -> Callable[[jax.Array, tuple[int, ...]], jax.Array]:
    def sample(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        return jax.random.randint(key, shape, 0, num_actions, jnp.int32)

    return sample


def _split(key: jax.Array, number: int) -> tuple[jax.Array, jax.Array]:
    """Returns the next key, and `number` keys for one step."""
    next_key, step_key = jax.random.split(key)
    return next_key, jax.random.split(step_key, number)


if __name__ == "__main__":
    harness.run(main, Options, "peers")
