"""Our learner beside others: `python -m benchmarks.learner_peers`.

Times a whole iteration, rollout and update, of `agents.ppo`, of the program in
`agents/examples/plain_ppo.py` (recurrent PPO with ICM) and of rejax's PPO, in turn within one
process. Settings follow preset `paper`, with fewer episodes and epochs. There are three
networks; the others' programs play the last two through the gymnax adapter, which needs the extra
`[interop]`:

    paper        the paper's, in our own environment
    dense        encoder and GRU of 128 units, as in PureJaxRL's recurrent PPO
    feedforward  two layers of 64 units, without memory and curiosity, as in rejax's PPO; our
                 network keeps the layers of its GRU

`plain` is one compiled program, as is usual in JAX. `plain-by-step` calls each gradient step from
Python, because XLA's CPU backend is slow at derivatives of convolutions in a loop.
"""

import dataclasses
import statistics
from collections.abc import Callable
from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from rich.table import Table

import agents.networks
import trap_tube_jax as tt
from agents import Config, make_learner
from agents.examples import plain_ppo
from benchmarks import harness

NetworkName = Literal["paper", "dense", "feedforward"]
ProgramName = Literal["ours", "plain", "plain-by-step", "rejax"]
PROGRAMS: dict[NetworkName, tuple[ProgramName, ...]] = {
    "paper": ("ours", "plain", "plain-by-step"),
    "dense": ("ours", "plain", "plain-by-step"),
    "feedforward": ("ours", "rejax"),
}
SETTINGS: dict[NetworkName, dict[str, Any]] = {
    "paper": {},
    "dense": {"encoder": "dense", "hidden": 128},
    "feedforward": {"encoder": "dense", "hidden": 64, "recurrent": False, "curiosity": "none"},
}
# A compiled iteration, state -> (state, environment steps taken); the seconds of tracing and
# compiling; and the first state.
Program = tuple[Callable[[Any], tuple[Any, jax.Array]], float, Any]


class DenseEncoder(nn.Module):
    """Encodes u8[..., 12, 12, N] to f32[..., units] by one layer."""

    units: int

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        """Flattens the features, scaled to [-1, 1]."""
        flat = observation.reshape(*observation.shape[:-3], -1)
        return nn.swish(plain_ppo.dense(self.units)(flat / 127.5 - 1))


agents.networks.register("dense", lambda config: DenseEncoder(config.hidden))


@dataclasses.dataclass(frozen=True)
class Options(harness.Options):
    """Times iterations of our learner and of plain programs.

    Attributes:
      sets: task sets to train on, by id or short name.
      networks: networks to train.
      programs: programs to compare, as far as they train a network; the first is compared with
        the others.
      episodes_per_iteration: episodes of an iteration; the paper has 1,024.
      minibatch_size: episodes of a gradient step; the paper has 128.
      epochs: passes over the episodes; the paper has 10.
    """

    repeats: int = 3
    sets: tuple[str, ...] = ("base",)
    networks: tuple[NetworkName, ...] = ("paper", "dense", "feedforward")
    programs: tuple[ProgramName, ...] = ("ours", "plain", "plain-by-step", "rejax")
    episodes_per_iteration: int = 64
    minibatch_size: int = 8
    epochs: int = 1

    def config(self, task_set: str, network: NetworkName) -> Config:
        """Returns the settings of training."""
        return Config.preset(
            "paper",
            env_id=tt.task_set(task_set).id,
            episodes_per_iteration=self.episodes_per_iteration,
            minibatch_size=self.minibatch_size,
            epochs=self.epochs,
            **SETTINGS[network],
        )


class ThroughGymnax:
    """A task set by the gymnax adapter, as the plain program plays it."""

    def __init__(self, config: Config):
        """Makes the environment of a config.

        Raises:
          ImportError: gymnax is not installed.
        """
        from trap_tube_jax.adapters import to_gymnax  # noqa: PLC0415  needs the extra

        self._env, self._params = to_gymnax.make(config.env_id, flat_actions=False)
        self.observation_spec = self._env.observation_space()
        self.max_steps = config.step_limit

    def reset(self, key: jax.Array) -> tuple[tuple[tt.State, jax.Array], tt.TimeStep]:
        """Draws a task."""
        key, reset_key = jax.random.split(key)
        observation, state = self._env.reset(reset_key, self._params)
        flags = (state.terminated, state.truncated)
        return (state, key), tt.TimeStep(observation, jnp.zeros(()), *flags, jnp.ones(()))

    def step(self, state: tuple[tt.State, jax.Array], action: jax.Array) -> tuple[Any, tt.TimeStep]:
        """Takes one action; the next task follows the end of an episode."""
        key, step_key = jax.random.split(state[1])
        stepped = self._env.step(step_key, state[0], action, self._params)
        observation, inner, reward, _, info = stepped
        flags = (info["terminated"], info["truncated"], info["discount"])
        return (inner, key), tt.TimeStep(observation, reward, *flags)


@dataclasses.dataclass(frozen=True)
class Speed:
    """Speed of one program.

    Attributes:
      task_set: short name of the task set.
      network: name of the network.
      program: name of the program.
      steps_per_s: environment steps per second of iterations, rollout and update.
      timing: seconds of an iteration.
    """

    task_set: str
    network: str
    program: str
    steps_per_s: float
    timing: harness.Timing


def our_program(config: Config) -> Program:
    """Compiles an iteration of `agents.ppo`."""
    learner = make_learner(config)

    def iterate(state: Any) -> tuple[Any, jax.Array]:
        after, _ = learner.iterate(state)
        return after, after.transitions - state.transitions

    state = jax.jit(learner.init)(jax.random.key(0))
    return *harness.compiled(iterate, state), state


def plain_program(learner: plain_ppo.PlainPPO) -> Program:
    """Compiles an iteration of the plain program as a whole."""

    def iterate(state: plain_ppo.TrainState) -> tuple[plain_ppo.TrainState, jax.Array]:
        state, batch, minibatches = learner.collect(state)
        update = lambda state, chosen: learner.update(state, batch, chosen)  # noqa: E731
        state, _ = jax.lax.scan(update, state, minibatches)
        return state, jnp.sum(batch[0].mask)

    state = jax.jit(learner.init)(jax.random.key(0))
    return *harness.compiled(iterate, state), state


def plain_program_by_step(learner: plain_ppo.PlainPPO) -> Program:
    """Compiles an iteration of the plain program as two functions, called from Python."""
    state = jax.jit(learner.init)(jax.random.key(0))
    collect, collect_s = harness.compiled(learner.collect, state)
    _, batch, minibatches = jax.eval_shape(learner.collect, state)
    chosen = jax.ShapeDtypeStruct(minibatches.shape[1:], minibatches.dtype)
    update, update_s = harness.compiled(learner.update, state, batch, chosen)

    def iterate(state: plain_ppo.TrainState) -> tuple[plain_ppo.TrainState, jax.Array]:
        state, batch, minibatches = collect(state)
        for chosen in minibatches:
            state, _ = update(state, batch, chosen)
        return state, jnp.sum(batch[0].mask)

    return iterate, collect_s + update_s, state


def rejax_program(config: Config) -> Program:
    """Compiles an iteration of rejax's PPO, which steps as many environments as many times.

    Raises:
      ImportError: rejax or gymnax is not installed.
    """
    import rejax  # noqa: PLC0415  # pyright: ignore[reportMissingImports]  needs the extra

    from trap_tube_jax.adapters import to_gymnax  # noqa: PLC0415

    env, params = to_gymnax.make(config.env_id)
    num_steps = config.step_limit
    ppo = rejax.PPO.create(
        env=env,
        env_params=params,
        num_envs=config.episodes_per_iteration,
        num_steps=num_steps,
        num_epochs=config.epochs,
        num_minibatches=config.episodes_per_iteration // config.minibatch_size,
        agent_kwargs={"hidden_layer_sizes": (config.hidden, config.hidden)},
    )
    steps = jnp.array(config.episodes_per_iteration * num_steps)
    state = jax.jit(ppo.init_state)(jax.random.key(0))
    return *harness.compiled(lambda state: (ppo.train_iteration(state), steps), state), state


def make_program(name: ProgramName, config: Config, network: NetworkName) -> Program:
    """Compiles the program of a name."""
    if name == "ours":
        return our_program(config)
    if name == "rejax":
        return rejax_program(config)
    env = None
    encoder = None
    if network == "dense":
        env = ThroughGymnax(config)
        encoder = DenseEncoder(config.hidden)
    learner = plain_ppo.PlainPPO(config, env, encoder)
    return plain_program(learner) if name == "plain" else plain_program_by_step(learner)


def measure(task_set: str, network: NetworkName, options: Options) -> list[Speed]:
    """Times the programs in alternating calls, after a warm-up round."""
    config = options.config(task_set, network)
    programs = {
        name: make_program(name, config, network)
        for name in options.programs
        if name in PROGRAMS[network]
    }
    states: dict[str, Any] = {name: state for name, (*_, state) in programs.items()}
    steps: dict[str, list[float]] = {name: [] for name in programs}
    calls: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(options.repeats + 1):
        for name, (iterate, *_) in programs.items():
            (states[name], taken), spent = harness.timed(iterate, states[name])
            steps[name].append(float(taken))
            calls[name].append(spent)
    speeds = []
    for name, (_, compile_s, _) in programs.items():
        timing = harness.Timing.of(compile_s, calls[name][1:])
        speed = statistics.mean(steps[name][1:]) / timing.median_s
        speeds.append(Speed(task_set, network, name, speed, timing))
    return speeds


def main(options: Options) -> list[Speed]:
    """Measures, prints a table and writes the record."""
    cases: list[tuple[str, NetworkName]] = [
        (name, network) for name in options.sets for network in options.networks
    ]
    for case in cases:
        options.config(*case)  # checks the settings
        network = case[1]
        if not set(options.programs) & set(PROGRAMS[network]):
            allowed = ", ".join(PROGRAMS[network])
            raise ValueError(f"no program of --programs has network {network}; allowed: {allowed}")
    console = harness.begin(options)
    results = []
    columns = ("set", "network", "program", "s/iteration", "steps/s", "ratio", "compile, s")
    table = Table(*columns)
    for case in cases:
        speeds = measure(*case, options)
        results += speeds
        for speed in speeds:
            table.add_row(
                *case,
                speed.program,
                f"{speed.timing.median_s:.3f}",
                f"{speed.steps_per_s:,.0f}",
                f"{speeds[0].steps_per_s / speed.steps_per_s:.1f}",
                f"{speed.timing.compile_s:.1f}",
            )
    console.print(table)
    harness.write_record("learner_peers", options, results)
    return results


if __name__ == "__main__":
    harness.run(main, Options, "learner_peers")
