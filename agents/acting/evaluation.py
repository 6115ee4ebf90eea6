"""Greedy evaluation on fixed tasks, drawn with keys that training never draws.

A key that training never draws may still give a task that it has seen: base is one task, {Sy}
five, {St} and {St, Sy} one and five layouts in any colours.
"""

import functools
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import trap_tube_jax as tt
from agents.acting.frames import Frame
from agents.acting.rollout import greedy_action, rollout
from agents.acting.scores import Optimality, Score
from agents.config import Config
from agents.networks.agent import Agent, Params
from agents.parallel.sharding import ALONE, DEFAULT_DEVICE, Placement, Shards
from trap_tube_jax.environment import Environment
from trap_tube_jax.objects import MAX_STEPS
from trap_tube_jax.registry import PAPER_TASK_SETS
from trap_tube_jax.state import State

Purpose = Literal["test", "validation"]

ALL_SETS = tuple(entry.short for entry in PAPER_TASK_SETS)
# How many layouts a set has, whatever their colours, where these are few.
NUM_LAYOUTS = {"base": 1, "st": 1, "sy": 5, "stsy": 5}
BLOCK = 1024  # tasks played at once: bounds the memory, whatever their number

# "trap" and "tube", or "trap" and "vali". The first word of every `jax.random.key(seed)` is
# 0, so no seed of training leads here.
_ROOTS: dict[Purpose, np.ndarray] = {
    "test": np.array([0x74726170, 0x74756265], np.uint32),
    "validation": np.array([0x74726170, 0x76616C69], np.uint32),
}


class Evaluation(NamedTuple):
    """B episodes of greedy play.

    Attributes:
      solved: bool[B].
      length: i32[B], steps taken.
      action: i32[B, T, 2], (grasp, move); without meaning from `length` on.
      value: f32[B, T], the network's value of every state, of the task's rewards where each
        stream of rewards has its own; likewise.
    """

    solved: jax.Array
    length: jax.Array
    action: jax.Array
    value: jax.Array


def evaluation_tasks(
    task_set: str,
    num_tasks: int,
    num_features: int = 3,
    max_steps: int = MAX_STEPS,
    purpose: Purpose = "test",
) -> State:
    """The fixed evaluation tasks of a registered set: B states, the same at every call.

    B is `num_tasks`, or 1 for a set without transfers, whose tasks are all the same.

    Args:
      task_set: an id or a short name.
      num_tasks: at least 1.
      num_features: N, feature channels.
      max_steps: the step limit.
      purpose: `test` tasks are reported; by `validation` tasks training is stopped, and its
        best parameters are chosen.

    Raises:
      ValueError: naming the value and what is allowed.
    """
    env = tt.make(task_set, num_features=num_features, max_steps=max_steps)
    return fixed_tasks(env, tt.task_set(task_set).id, num_tasks, purpose)


def fixed_tasks(env: Environment, name: str, num_tasks: int, purpose: Purpose = "test") -> State:
    """As `evaluation_tasks`, for any environment; `name` sets its tasks apart from others'.

    They are the tasks that `env.reset` draws from `evaluation_keys(name, B, purpose)`.

    Raises:
      ValueError: `num_tasks` is below 1.
    """
    if num_tasks < 1:
        raise ValueError(f"the number of evaluation tasks must be >= 1, got {num_tasks}")
    count = num_tasks if env.transfers else 1
    # Transfers are compiled one by one: the sets share them, so eight sets take three
    # compilations, and a transfer has the same bits in each.
    draw = tt.compose(*map(_compiled, env.transfers))
    base = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), env.base)
    return jax.vmap(draw)(evaluation_keys(name, count, purpose), base)


def evaluation_keys(name: str, num_tasks: int, purpose: Purpose = "test") -> jax.Array:
    """The PRNG keys [B] of the evaluation tasks of the set with this id.

    More tasks begin with the same ones. No key serves two purposes or sets.
    """
    root = jax.random.wrap_key_data(jnp.asarray(_ROOTS[purpose]), impl="threefry2x32")
    set_key = jax.random.fold_in(root, zlib.crc32(name.encode()))
    return jax.vmap(jax.random.fold_in, in_axes=(None, 0))(set_key, jnp.arange(num_tasks))


def layout_numbers(name: str, tasks: State) -> np.ndarray | None:
    """The layout i32[B] of each task, counted from 0; None unless the set has few.

    A layout is a state without its colours.

    Args:
      name: the set's short name.
      tasks: B states at time 0.
    """
    if name not in NUM_LAYOUTS:
        return None
    parts = (tasks.board, tasks.agent, tasks.tool, tasks.tool_extent, tasks.food)
    rows = np.concatenate([np.asarray(part).reshape(len(part), -1) for part in parts], axis=1)
    return np.unique(rows, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int32)


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
    frame = jax.vmap(Frame.facing_food if agent.facing else Frame.of_board)(
        jax.vmap(tt.observe)(tasks)
    )
    seen = jax.vmap(Frame.state)(frame, tasks)
    unused_key = jax.random.key(0)
    played = rollout(agent, params, env, seen, unused_key, choose=greedy_action, chunk=chunk)
    episodes = played.episodes
    action = jax.vmap(Frame.original_action)(frame, episodes.action.swapaxes(0, 1))
    value = played.value[:-1, :, 0].swapaxes(0, 1)
    outcome = Evaluation(episodes.solved, episodes.length, action, value)
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
        self._play: Any = placement.share(
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

    def compile(self, params: Params) -> None:
        """Compiles for parameters of these shapes, as the first call would; for one device."""
        self._play = self._play.lower(params, self._blocks[0]).compile()

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
    tasks: Mapping[str, State],
    max_steps: int,
    shortest: Mapping[str, np.ndarray] | None = None,
) -> list[Score]:
    """The score of every set; with `shortest`, by set, compared with shortest plans.

    Args:
      played: what an `Evaluator` returned.
      tasks: its tasks.
      max_steps: the step limit.
      shortest: the lengths i32[B] of each set's shortest plans, if known.
    """
    made = []
    for name, outcome in played.items():
        solved, length = np.asarray(outcome.solved), np.asarray(outcome.length)
        found = None
        if shortest is not None:
            found = Optimality.of(solved, length, shortest[name], max_steps)
        layout = layout_numbers(name, tasks[name])
        made.append(Score.of(name, label(name), solved, length, layout=layout, optimality=found))
    return made


def label(name: str) -> str:
    """A registered set's name in the paper's notation; any other name as it is."""
    known = {tt.task_set(id).short: tt.task_set(id).label for id in tt.registered_ids()}
    return known.get(name, name)


@functools.cache
def _compiled(transfer: tt.Transfer) -> tt.Transfer:
    return jax.jit(transfer)


def _rows(tree: Any, index: Any) -> Any:
    return jax.tree.map(lambda x: x[index], tree)
