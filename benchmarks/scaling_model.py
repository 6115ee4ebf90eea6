"""What several devices cost and gain: python -m benchmarks.scaling_model --help.

Counts the bytes that devices exchange per iteration in the compiled program, and, with
--measure, times one device's share of the work for every number of devices. From both
follows the speed-up, by the model in `benchmarks/results/scale.md`.
"""

import dataclasses
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from agents.acting.rollout import sample_action
from agents.command_line import Flag
from agents.config import PRESETS, Config
from agents.networks.actions import ActionDistribution
from agents.parallel.sharding import Placement
from agents.ppo.learner import make_train
from agents.runs.programs import Programs
from agents.runs.table import Table, number
from benchmarks import harness
from trap_tube_jax.command_line import plain_errors
from trap_tube_jax.objects import NUM_DIRECTIONS
from trap_tube_jax.registry import task_set

COUNTED_DEVICES = 8
SEEDS = 8  # trained side by side in the model's last column
BYTES = {"pred": 1, "u8": 1, "s8": 1, "u16": 2, "s16": 2, "u32": 4, "s32": 4, "f32": 4, "f64": 8}
COLLECTIVE = re.compile(
    r"= (?P<shape>\(?[a-z0-9]+\[.*?) (?P<kind>all-reduce|all-gather|all-to-all|"
    r"collective-permute|reduce-scatter)(?:-start)?\("
)
COMPUTATION = re.compile(r"^(?:ENTRY )?%?(?P<name>[\w.\-]+) \(.*\{$")
CALLED = re.compile(
    r"(?:body|condition|to_apply|calls)=%?([\w.\-]+)|branch_computations=\{([^}]*)\}"
)
TRIPS = re.compile(r'known_trip_count":\{"n":"(\d+)"')


@dataclasses.dataclass(frozen=True)
class Options:
    """Counts what devices exchange; with --measure, times their work and models the speed-up.

    Attributes:
      preset: the settings.
      env: the task set.
      measure: time the shares of work; needs a quiet machine.
      latency: seconds of one step of a ring between devices.
      bandwidth: bytes per second of each device's link.
      output: write the record to this file; refused unless all is of committed code.
    """

    preset: Annotated[str, tyro.conf.arg(metavar="|".join(PRESETS))] = "paper"
    env: str = "TrapTube-v0"
    measure: Flag = False
    latency: float = 10e-6
    bandwidth: float = 12.5e9
    output: Path | None = None


@dataclasses.dataclass(frozen=True)
class Exchange:
    """A collective operation of the compiled program.

    Attributes:
      kind: its name in HLO.
      bytes: size of its result.
      calls: how often an iteration runs it.
    """

    kind: str
    bytes: int
    calls: int


def exchanges(*modules: str) -> list[Exchange]:
    """The collectives of HLO modules, counted through loops of known length.

    Raises:
      ValueError: one runs in a loop whose length depends on the data.
    """
    found: Counter[tuple[str, int]] = Counter()
    for hlo in modules:
        lines: dict[str, list[str]] = {}
        entry = name = ""
        for line in hlo.splitlines():
            if match := COMPUTATION.match(line):
                name = match["name"]
                lines[name] = []
                entry = name if line.startswith("ENTRY") else entry
            elif name:
                lines[name].append(line)
        _count(lines, entry, 1, found)
    return [Exchange(kind, size, calls) for (kind, size), calls in sorted(found.items())]


def _count(
    lines: dict[str, list[str]], name: str, calls: int | None, found: Counter[tuple[str, int]]
) -> None:
    for line in lines.get(name, ()):
        if match := COLLECTIVE.search(line):
            if calls is None:
                raise ValueError(f"a loop of unknown length exchanges data: {line.strip()[:120]}")
            found[match["kind"], _num_bytes(match["shape"])] += calls
        times = calls
        if " while(" in line:
            trips = TRIPS.search(line)
            times = calls * int(trips[1]) if trips and calls is not None else None
        for called, branches in CALLED.findall(line):
            for other in filter(None, [called, *branches.replace("%", "").split(", ")]):
                _count(lines, other, times, found)


def _num_bytes(shape: str) -> int:
    arrays = re.findall(r"([a-z]+\d*)\[([\d,]*)\]", shape)
    sizes = [np.prod([int(n) for n in dims.split(",") if n]) for _, dims in arrays]
    return sum(BYTES[kind] * int(size) for (kind, _), size in zip(arrays, sizes, strict=True))


def compiled_exchanges(config: Config, devices: int) -> list[Exchange]:
    """Those of one iteration of training on this many devices of this process."""
    placement = Placement.of(devices, config, 1)
    train = make_train(config, shards=placement.episodes)
    state = placement.put(jax.jit(jax.vmap(train.init))(jax.random.split(jax.random.key(0), 1)))
    programs = Programs(train, placement, state, np.ones(1, bool))
    return exchanges(*(program.result().as_text() or "" for program in programs.pending))


def share_seconds(config: Config, devices: int) -> float:
    """Seconds of an iteration of 1 / `devices` of the episodes and of every minibatch."""
    share = dataclasses.replace(
        config,
        episodes=config.episodes_per_iteration // devices,
        minibatch=config.minibatch_size // devices,
    )
    train = make_train(share)
    state = jax.jit(train.init)(jax.random.key(0))
    iterate = jax.jit(train.iterate)
    return harness.measure(lambda: iterate(state), repeats=3).median_s


def repeated_seconds(config: Config) -> float:
    """Seconds of what every device does for all episodes: draws, rewards, advantages, ids."""
    curiosity = "counts" if config.curiosity == "counts" else "none"
    train = make_train(dataclasses.replace(config, curiosity=curiosity))
    state = jax.jit(train.init)(jax.random.key(0))
    logits = jnp.zeros((config.episodes_per_iteration, NUM_DIRECTIONS))
    step_keys = jax.random.split(jax.random.key(2), train.env.max_steps)

    @jax.jit
    def repeat(trajectory: Any) -> Any:
        distribution = ActionDistribution(logits, logits)
        actions = jax.lax.map(lambda key: sample_action(key, distribution), step_keys)
        return actions, train.prepare(state, trajectory)

    reset_keys = jax.random.split(jax.random.key(1), config.episodes_per_iteration)
    trajectory = jax.jit(train.play)(state.params, reset_keys, jax.random.key(3))
    return harness.measure(lambda: repeat(trajectory)).median_s


def speed_up_rows(
    options: Options, config: Config, found: Sequence[Exchange]
) -> list[dict[str, float | int | None]]:
    """The model for 1 to `SEEDS` x minibatch devices, powers of two."""
    updates = config.epochs * config.episodes_per_iteration // config.minibatch_size
    counts = [
        2**n for n in range(config.minibatch_size.bit_length()) if config.minibatch_size % 2**n == 0
    ]
    repeated = repeated_seconds(config)
    times, rows = {}, []
    for devices in counts:
        share = share_seconds(config, devices)
        exchange = exchange_seconds(found, devices, options.latency, options.bandwidth)
        again = repeated * (1 - 1 / devices)
        times[devices] = share + again + exchange
        rows.append({"share_s": share, "repeated_s": again, "exchange_s": exchange})
        print(f"{devices} devices: {share:.3f} s for {updates} updates", flush=True)
    result: list[dict[str, float | int | None]] = []
    for devices in sorted({*counts, *(SEEDS * n for n in counts)}):
        shards = max(1, devices // SEEDS)
        result.append(
            {
                "devices": devices,
                **(rows[counts.index(devices)] if devices in times else {}),
                "one_seed": times[1] / times[devices] if devices in times else None,
                "all_seeds": min(devices, SEEDS) * times[1] / times[shards],
            }
        )
    return result


def exchange_seconds(
    found: Sequence[Exchange], devices: int, latency: float, bandwidth: float
) -> float:
    """Seconds that an iteration's collectives take on rings of this many devices."""
    seconds = 0.0
    for exchange in found:
        passes = 2 if exchange.kind == "all-reduce" else 1
        moved = exchange.bytes * (devices - 1) / devices
        steps = devices - 1
        seconds += exchange.calls * passes * (moved / bandwidth + steps * latency)
    return seconds


def exchange_table(found: Sequence[Exchange]) -> str:
    """The collectives, in Markdown."""
    heads = ("operation", "times per iteration", "bytes each", "bytes per iteration")
    rows = [
        (each.kind, f"{each.calls:,}", f"{each.bytes:,}", f"{each.bytes * each.calls:,}")
        for each in found
    ]
    return Table("", heads, tuple(rows)).to_markdown()


def speed_up_table(rows: Sequence[dict[str, float | int | None]]) -> str:
    """The model, in Markdown."""
    heads = ("devices", "own share, s", "repeated, s", "exchange, s", "speed-up, one seed")
    names = ("share_s", "repeated_s", "exchange_s", "one_seed", "all_seeds")
    cells = [
        (f"{row['devices']:,}", *(number(row.get(name), ".3g") for name in names)) for row in rows
    ]
    return Table("", (*heads, f"speed-up, {SEEDS} seeds"), tuple(cells)).to_markdown()


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` are those of the process if absent."""
    options = tyro.cli(Options, args=arguments, prog="python -m benchmarks.scaling_model")
    if not options.latency >= 0:
        raise ValueError(f"latency must be >= 0, got {options.latency}")
    if not options.bandwidth > 0:
        raise ValueError(f"bandwidth must be > 0, got {options.bandwidth}")
    config = Config.preset(options.preset, env_id=task_set(options.env).id)
    harness.use_devices(COUNTED_DEVICES)
    harness.check_recordable(options.output)
    found = compiled_exchanges(config, COUNTED_DEVICES)
    print(exchange_table(found))
    rows = speed_up_rows(options, config, found) if options.measure else []
    if rows:
        print(speed_up_table(rows))
    if options.output is not None:
        settings = {**dataclasses.asdict(options), "output": None, "config": config.to_dict()}
        extra = {"settings": settings, "model": rows}
        harness.write_record(options.output, "scaling_model", options, found, **extra)


if __name__ == "__main__":
    with plain_errors():
        main()
