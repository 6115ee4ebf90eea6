"""Greedy evaluation on fixed tasks that training never draws.

On the command line, `python -m agents.evaluate runs/<name>`, or `--pretrained <name>` for
parameters that are shipped.
"""

import dataclasses
import functools
import sys
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.console import Console

import trap_tube_jax as tt
from agents import pretrained
from agents.acting.rollout import greedy_action, rollout
from agents.config import Config
from agents.networks.agent import Agent, Params, Policy
from agents.parallel.sharding import ALONE, DEFAULT_DEVICE, Placement, Shards
from agents.runs import checkpoint, compilation_cache, report
from agents.runs.folder import RunFolder, write_json
from agents.runs.metrics import Optimality, Score
from trap_tube_jax.environment import Environment
from trap_tube_jax.objects import MAX_STEPS
from trap_tube_jax.registry import PAPER_TASK_SETS
from trap_tube_jax.state import State

ALL_SETS = tuple(entry.short for entry in PAPER_TASK_SETS)
BLOCK = 1024  # tasks played at once: bounds the memory, whatever their number

# "trap" and "tube". The first word of every `jax.random.key(seed)` is 0, so no seed of
# training leads here.
_ROOT = np.array([0x74726170, 0x74756265], np.uint32)


class Evaluation(NamedTuple):
    """B episodes of greedy play.

    Attributes:
      solved: bool[B].
      length: i32[B], steps taken.
      action: i32[B, T, 2], (grasp, move); without meaning from `length` on.
    """

    solved: jax.Array
    length: jax.Array
    action: jax.Array


def evaluation_tasks(
    task_set: str, num_tasks: int, num_features: int = 3, max_steps: int = MAX_STEPS
) -> State:
    """The fixed evaluation tasks of a registered set: B states, the same at every call.

    B is `num_tasks`, or 1 for a set without transfers, whose tasks are all the same.

    Args:
      task_set: an id or a short name.
      num_tasks: at least 1.
      num_features: N, feature channels.
      max_steps: the step limit.

    Raises:
      ValueError: naming the value and what is allowed.
    """
    env = tt.make(task_set, num_features=num_features, max_steps=max_steps)
    return fixed_tasks(env, tt.task_set(task_set).id, num_tasks)


def fixed_tasks(env: Environment, name: str, num_tasks: int) -> State:
    """As `evaluation_tasks`, for any environment; `name` sets its tasks apart from others'.

    They are the tasks that `env.reset` draws from `evaluation_keys(name, B)`.
    """
    if num_tasks < 1:
        raise ValueError(f"the number of evaluation tasks must be >= 1, got {num_tasks}")
    count = num_tasks if env.transfers else 1
    # Transfers are compiled one by one: the sets share them, so eight sets take three
    # compilations, and a transfer has the same bits in each.
    draw = tt.compose(*map(_compiled, env.transfers))
    base = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), env.base)
    return jax.vmap(draw)(evaluation_keys(name, count), base)


def evaluation_keys(name: str, num_tasks: int) -> jax.Array:
    """The PRNG keys [B] of the evaluation tasks of the set with this id.

    More tasks begin with the same ones.
    """
    root = jax.random.wrap_key_data(jnp.asarray(_ROOT), impl="threefry2x32")
    set_key = jax.random.fold_in(root, zlib.crc32(name.encode()))
    return jax.vmap(jax.random.fold_in, in_axes=(None, 0))(set_key, jnp.arange(num_tasks))


def evaluate(
    agent: Agent,
    params: Params,
    env: Environment,
    tasks: State,
    chunk: int,
    shards: Shards = ALONE,
) -> Evaluation:
    """Plays every task once with the most probable actions. Pure; jit it.

    Args:
      agent: the network.
      params: its parameters.
      env: the dynamics and the step limit; its transfers play no part.
      tasks: B states at time 0.
      chunk: distinct observations encoded at once; more than B are of no use.
      shards: how devices divide the tasks among themselves, evenly or not.
    """
    num_tasks = tasks.time.shape[0]
    if shards.count > 1:
        tasks = _rows(tasks, shards.places(num_tasks)[0])
    chunk = min(chunk, tasks.time.shape[0])
    unused_key = jax.random.key(0)
    played = rollout(agent, params, env, tasks, unused_key, choose=greedy_action, chunk=chunk)
    episodes = played.episodes
    outcome = Evaluation(episodes.solved, episodes.length, episodes.action.swapaxes(0, 1))
    return outcome if shards.count == 1 else _rows(shards.whole(outcome), slice(num_tasks))


class Evaluator:
    """Greedy play on the tasks of several sets, compiled once for any parameters."""

    def __init__(
        self, config: Config, tasks: Mapping[str, State], placement: Placement = DEFAULT_DEVICE
    ):
        """Prepares the play.

        Args:
          config: the settings of the policies to come.
          tasks: the tasks of each set, by any name; see `evaluation_tasks`.
          placement: the devices that share the tasks.
        """
        self.tasks = dict(tasks)
        self._total = sum(len(states.time) for states in self.tasks.values())
        block = min(BLOCK, self._total)
        self._blocks = [
            _rows(self._all_tasks(), np.arange(start, start + block) % self._total)
            for start in range(0, self._total, block)
        ]
        env = tt.Environment(base=tt.base_state(config.num_features), max_steps=config.max_steps)
        agent = Agent(config)
        shards = Shards(placement.num_devices)
        self._play = placement.share(
            lambda params, states: evaluate(agent, params, env, states, config.chunk, shards)
        )

    @classmethod
    def of_sets(
        cls,
        config: Config,
        sets: Sequence[str],
        num_tasks: int,
        placement: Placement = DEFAULT_DEVICE,
    ) -> "Evaluator":
        """That of registered task sets.

        Raises:
          ValueError: unknown set, no set, or no task.
        """
        if not sets:
            raise ValueError(f"name at least one task set; allowed: {', '.join(ALL_SETS)}")
        names = [tt.task_set(name).short for name in sets]
        make = functools.partial(
            evaluation_tasks,
            num_tasks=num_tasks,
            num_features=config.num_features,
            max_steps=config.max_steps,
        )
        return cls(config, {name: make(name) for name in names}, placement)

    def __call__(self, params: Params) -> dict[str, Evaluation]:
        """Outcomes as NumPy arrays, by the names of the tasks."""
        played = [jax.tree.map(np.asarray, self._play(params, states)) for states in self._blocks]
        whole = jax.tree.map(lambda *parts: np.concatenate(parts)[: self._total], *played)
        ends = np.cumsum([len(states.time) for states in self.tasks.values()])
        starts = np.concatenate([[0], ends[:-1]])
        return {
            name: _rows(whole, slice(start, end))
            for name, start, end in zip(self.tasks, starts, ends, strict=True)
        }

    def _all_tasks(self) -> State:
        return jax.tree.map(lambda *parts: jnp.concatenate(parts), *self.tasks.values())


def shortest_lengths(tasks: State) -> np.ndarray:
    """i32[B]: the lengths of the shortest plans, -1 where unsolvable."""
    from trap_tube_jax import solver  # noqa: PLC0415  needed on request only

    return np.asarray(solver.solve_batch(tasks).length)


def scores(
    played: Mapping[str, Evaluation],
    max_steps: int,
    shortest: Mapping[str, np.ndarray] | None = None,
) -> list[Score]:
    """The score of every set; with `shortest`, by set, compared with shortest plans.

    Args:
      played: what an `Evaluator` returned.
      max_steps: the step limit.
      shortest: the lengths i32[B] of each set's shortest plans, if known.
    """
    return [
        _score(name, outcome, max_steps, None if shortest is None else shortest[name])
        for name, outcome in played.items()
    ]


def save_solved_episode(
    path: Path, evaluator: Evaluator, played: Mapping[str, Evaluation], prefer: str
) -> str | None:
    """Writes a GIF of the first solved episode, of the set `prefer` if there is one.

    Returns:
      The name of its set, or None if no episode is solved: then nothing is written.
    """
    for name in sorted(played, key=lambda name: name != prefer):
        outcome = played[name]
        if np.any(outcome.solved):
            index = int(np.argmax(outcome.solved))
            actions = np.asarray(outcome.action[index, : outcome.length[index]])
            report.save_episode(_rows(evaluator.tasks[name], index), actions, path)
            return name
    return None


def load_run(path: Path, iteration: int | None = None) -> list[Policy]:
    """The policies of a run, one per seed.

    Args:
      path: its folder.
      iteration: the checkpoint to take; the newest if absent.

    Raises:
      ValueError: there is no run or no such checkpoint, or it cannot be read.
    """
    folder, run = RunFolder.open(path)
    with checkpoint.Checkpoints(folder.checkpoints) as checkpoints:
        arrays, record = checkpoints.load(iteration)
        params = jax.tree.map(jnp.asarray, checkpoint.subtree(arrays, "params"))
        expected = jax.eval_shape(Agent(run.config).init, jax.random.key(0))
        try:
            policies = [_rows(params, index) for index in range(run.seeds)]
            checkpoint.from_arrays(checkpoint.to_arrays(policies[0]), expected)
        except (ValueError, IndexError) as error:
            raise checkpoints.refuse(record["iteration"], f"does not fit ({error})") from error
    iterations = np.broadcast_to(arrays["iteration"], (run.seeds,))
    return [
        Policy(f"seed {seed}", run.config, policy, int(done))
        for seed, policy, done in zip(run.seed_range, policies, iterations, strict=True)
    ]


@functools.cache
def _compiled(transfer: tt.Transfer) -> tt.Transfer:
    return jax.jit(transfer)


def _score(name: str, outcome: Evaluation, max_steps: int, shortest: np.ndarray | None) -> Score:
    known = {tt.task_set(id).short: tt.task_set(id) for id in tt.registered_ids()}.get(name)
    solved, length = np.asarray(outcome.solved), np.asarray(outcome.length)
    return Score.of(
        name,
        known.label if known else name,
        solved,
        length,
        is_sample=known is None or bool(known.transfers),
        optimality=None if shortest is None else Optimality.of(solved, length, shortest, max_steps),
    )


def _rows(tree: Any, index: Any) -> Any:
    return jax.tree.map(lambda x: x[index], tree)


Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]


@dataclasses.dataclass(frozen=True)
class Options:
    """Evaluates a trained agent greedily, on fixed tasks that training never draws.

    Attributes:
      run: a run's folder, or a file of parameters.
      pretrained: the name of shipped parameters, instead of a run.
      sets: ids or short names of task sets.
      episodes: tasks per set; the run's `eval_episodes` if absent. The base set has one.
      iteration: the checkpoint to evaluate; the newest if absent.
      gif: write the first solved episode to this file.
      json: write the results to this file.
      optimality: compare with shortest plans, which are searched for first (a second for
        each task of a perceptual set).
      no_cache: compile everything anew, instead of keeping compiled programs in
        ~/.cache/trap_tube_jax from one time to the next.
    """

    run: Annotated[Path | None, tyro.conf.Positional] = None
    pretrained: str | None = None
    sets: tuple[str, ...] = ALL_SETS
    episodes: int | None = None
    iteration: int | None = None
    gif: Path | None = None
    json: Path | None = None
    optimality: Flag = False
    no_cache: Flag = False


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` are those of the process if absent."""
    options = tyro.cli(Options, args=arguments, prog="python -m agents.evaluate")
    if not options.no_cache:
        compilation_cache.enable()
    try:
        _evaluate_run(options)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from error


def _evaluate_run(options: Options) -> None:
    source, policies = _load(options)
    config = policies[0].config
    episodes = config.eval_episodes if options.episodes is None else options.episodes
    evaluator = Evaluator.of_sets(config, options.sets, episodes)
    shortest = None
    if options.optimality:
        shortest = {name: shortest_lengths(tasks) for name, tasks in evaluator.tasks.items()}
    played = {policy.name: evaluator(policy.params) for policy in policies}
    results = {
        name: scores(outcome, config.max_steps, shortest) for name, outcome in played.items()
    }
    console = Console()
    for policy in policies:
        title = f"{source}, {policy.name}, iteration {policy.iteration}"
        console.print(report.evaluation_table(results[policy.name], title))
    if options.json is not None:
        write_json(options.json, results_json(policies, results))
        console.print(f"results: {options.json}", soft_wrap=True)
    if options.gif is not None:
        prefer = tt.task_set(config.env_id).short
        shown = None
        for outcome in played.values():
            shown = shown or save_solved_episode(options.gif, evaluator, outcome, prefer)
        message = f"solved episode of {shown}: {options.gif}" if shown else "no episode is solved"
        console.print(message, soft_wrap=True)


def _load(options: Options) -> tuple[str, list[Policy]]:
    """Where the policies come from, for people, and the policies."""
    path = options.run
    if (path is None) == (options.pretrained is None):
        raise ValueError("give a run's folder or --pretrained NAME, one of them")
    if path is not None and not path.is_file():
        return path.name, load_run(path, options.iteration)
    if options.iteration is not None:
        raise ValueError("--iteration names a checkpoint of a run: a file of parameters has none")
    if path is not None:
        return path.parent.name, [pretrained.load(path)]
    return "pretrained", [pretrained.load_shipped(str(options.pretrained))]


def results_json(
    policies: Sequence[Policy], results: Mapping[str, Sequence[Score]]
) -> list[dict[str, Any]]:
    """The scores of every policy as plain values."""
    return [
        {
            "policy": policy.name,
            "iteration": policy.iteration,
            "sets": [dataclasses.asdict(score) for score in results[policy.name]],
        }
        for policy in policies
    ]


if __name__ == "__main__":
    main()
