"""This environment beside other JAX gridworlds: `python -m benchmarks.peers`.

Every subject runs under the same harness in the same process: random actions, auto-reset,
every byte of every observation consumed. The peers come with the extra `[bench]`; one that
cannot be imported is skipped with its reason.
"""

import dataclasses
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks import env_throughput, harness
from trap_tube_jax.command_line import plain_errors


@dataclasses.dataclass(frozen=True)
class Arguments:
    """What to measure.

    Attributes:
      num_envs: batch size, a multiple of `devices`.
      num_steps: steps of each environment per timed call.
      repeats: timed calls; the median counts.
      devices: devices to divide the environments over; a CPU is made to appear as so many.
      sets: our own task sets in the table; the first is the ratios' numerator.
      json: file to write the record to; refused unless all is of committed code.
    """

    num_envs: int = 4096
    num_steps: int = 100
    repeats: int = 5
    devices: int = 1
    sets: tuple[str, ...] = ("pstsy", "base")
    json: pathlib.Path | None = None


def gymnax_breakout() -> harness.Subject:
    """MinAtar Breakout of gymnax; its step resets by itself and takes a key."""
    import gymnax  # noqa: PLC0415 # pyright: ignore[reportMissingImports]

    env, params = gymnax.make("Breakout-MinAtar")

    def reset(keys):
        observation, state = jax.vmap(env.reset, (0, None))(keys, params)
        return (state, keys[0]), observation

    def step(carry, actions):
        state, key = carry
        key, step_keys = _split(key, len(actions))
        observation, state, *_ = jax.vmap(env.step, (0, 0, 0, None))(
            step_keys, state, actions, params
        )
        return (state, key), observation

    return harness.Subject("gymnax Breakout", reset, step, _actions(env.num_actions))


def pgx_breakout() -> harness.Subject:
    """MinAtar Breakout of pgx under its own auto-reset, which takes a key."""
    import pgx  # noqa: PLC0415 # pyright: ignore[reportMissingImports]
    from pgx.experimental import (  # noqa: PLC0415 # pyright: ignore[reportMissingImports]
        auto_reset,
    )

    env: Any = pgx.make("minatar-breakout")
    auto_step = auto_reset(env.step, env.init)

    def reset(keys):
        state = jax.vmap(env.init)(keys)
        return (state, keys[0]), state.observation

    def step(carry, actions):
        state, key = carry
        key, step_keys = _split(key, len(actions))
        state = jax.vmap(auto_step)(state, actions, step_keys)
        return (state, key), state.observation

    return harness.Subject("pgx Breakout", reset, step, _actions(env.num_actions))


def navix_doorkey() -> harness.Subject:
    """DoorKey-8x8 of Navix, which resets by itself."""
    import navix  # noqa: PLC0415 # pyright: ignore[reportMissingImports]

    env = navix.make("Navix-DoorKey-8x8-v0")

    def reset(keys):
        timestep = jax.vmap(env.reset)(keys)
        return timestep, timestep.observation

    def step(timestep, actions):
        timestep = jax.vmap(env.step)(timestep, actions)
        return timestep, timestep.observation

    return harness.Subject("Navix DoorKey-8x8", reset, step, _actions(len(env.action_set)))


def xland_doorkey() -> harness.Subject:
    """DoorKey-8x8 of XLand-MiniGrid under its own auto-reset."""
    import xminigrid  # noqa: PLC0415 # pyright: ignore[reportMissingImports]
    from xminigrid.wrappers import (  # noqa: PLC0415 # pyright: ignore[reportMissingImports]
        GymAutoResetWrapper,
    )

    env, params = xminigrid.make("MiniGrid-DoorKey-8x8")
    env = GymAutoResetWrapper(env)

    def reset(keys):
        timestep = jax.vmap(env.reset, (None, 0))(params, keys)
        return timestep, timestep.observation

    def step(timestep, actions):
        timestep = jax.vmap(env.step, (None, 0, 0))(params, timestep, actions)
        return timestep, timestep.observation

    return harness.Subject("XLand DoorKey-8x8", reset, step, _actions(env.num_actions(params)))


def jumanji_snake() -> harness.Subject:
    """Snake of Jumanji under its own auto-reset."""
    import jumanji  # noqa: PLC0415 # pyright: ignore[reportMissingImports]
    from jumanji.wrappers import (  # noqa: PLC0415 # pyright: ignore[reportMissingImports]
        AutoResetWrapper,
    )

    env: Any = AutoResetWrapper(jumanji.make("Snake-v1"))
    reset, step = jax.vmap(env.reset), jax.vmap(env.step)
    return harness.Subject(
        "Jumanji Snake", reset, step, _actions(4), lambda each: each.observation.grid
    )


PEERS: tuple[tuple[str, Callable[[], harness.Subject]], ...] = (
    ("gymnax Breakout", gymnax_breakout),
    ("pgx Breakout", pgx_breakout),
    ("Navix DoorKey-8x8", navix_doorkey),
    ("XLand DoorKey-8x8", xland_doorkey),
    ("Jumanji Snake", jumanji_snake),
)


INSTALL = " (pip install 'trap-tube-jax[bench]')"


def run(arguments: Arguments) -> tuple[list[harness.Throughput], dict[str, str]]:
    """Measures our own sets and every peer; returns results and reasons of the skipped peers.

    Raises:
      ValueError: one of our own sets is unknown, or cannot be measured.
    """

    def measure(subject: harness.Subject) -> harness.Throughput:
        return harness.measure_throughput(
            subject,
            arguments.num_envs,
            num_steps=arguments.num_steps,
            repeats=arguments.repeats,
            devices=arguments.devices,
        )

    own = [env_throughput.subject(name) for name in arguments.sets]
    results, skipped = [measure(subject) for subject in own], {}
    for name, make_subject in PEERS:
        try:
            results.append(measure(make_subject()))
        except Exception as error:  # whatever breaks in a peer must not break the others
            first_line = next(iter(str(error).splitlines()), "")
            hint = INSTALL if isinstance(error, ImportError) else ""
            skipped[name] = f"{type(error).__name__}: {first_line}{hint}"
    return results, skipped


def main(arguments: Arguments) -> None:
    """Measures, prints a table and the skipped peers, and writes JSON if asked to."""
    harness.check_counts(
        (arguments.num_envs,),
        num_steps=arguments.num_steps,
        repeats=arguments.repeats,
        devices=arguments.devices,
    )
    harness.use_devices(arguments.devices)
    harness.check_recordable(arguments.json)
    console = Console()
    console.print(harness.machine())
    results, skipped = run(arguments)
    table = Table("environment", "M steps/s", "ratio", "observation, B", "GB/s", "compile, s")
    for result in results:
        table.add_row(
            result.name,
            f"{result.steps_per_s / 1e6:.2f}",
            f"{results[0].steps_per_s / result.steps_per_s:.1f}",
            f"{result.observation_bytes}",
            f"{result.bytes_per_s / 1e9:.2f}",
            f"{result.timing.compile_s:.1f}",
        )
    console.print(table)
    for name, reason in skipped.items():
        console.print(f"skipped {name}: {reason}", markup=False)
    if arguments.json is not None:
        harness.write_record(arguments.json, "peers", arguments, results, skipped=skipped)


def _actions(num_actions: int) -> Callable[[jax.Array, tuple[int, ...]], jax.Array]:
    def sample(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        return jax.random.randint(key, shape, 0, num_actions, jnp.int32)

    return sample


def _split(key: jax.Array, number: int) -> tuple[jax.Array, jax.Array]:
    """The next key, and `number` keys for one step."""
    next_key, step_key = jax.random.split(key)
    return next_key, jax.random.split(step_key, number)


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Arguments, description=__doc__))
