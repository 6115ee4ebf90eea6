"""Greedy evaluation on the fixed tasks of the benchmark's protocol, by the network's fast path."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import trap_tube_jax as tt
from agents.acting.frames import Frame
from agents.acting.rollout import Trajectory, greedy_action, rollout
from agents.config import Config
from agents.networks.agent import Agent, Params
from trap_tube_jax.environment import Environment
from trap_tube_jax.scoring.benchmark import blocks
from trap_tube_jax.scoring.scores import Optimality, Score
from trap_tube_jax.scoring.tasks import ALL_SETS, evaluation_tasks, label, layout_numbers
from trap_tube_jax.solver.search import take
from trap_tube_jax.state import State


class Evaluation(NamedTuple):
    """B episodes of greedy play.

    Attributes:
      solved: bool[B].
      length: i32[B], steps taken.
      action: i32[B, T, 2], (grasp, move); without meaning from `length` on.
      value: f32[B, T], the network's value of every state; of the task's rewards alone where the
        intrinsic reward has a value of its own. Without meaning from `length` on, too.
    """

    solved: jax.Array
    length: jax.Array
    action: jax.Array
    value: jax.Array


def evaluate(agent: Agent, params: Params, env: Environment, tasks: State) -> Evaluation:
    """Plays every task once with the most probable actions. Pure; jit it.

    Args:
      agent: the network.
      params: its parameters.
      env: the dynamics and the step limit; its transfers play no part.
      tasks: B states at time 0.
    """
    frame, played = play_greedily(agent, params, env, tasks)
    episodes = played.episodes
    action = jax.vmap(Frame.original_action)(frame, episodes.action.swapaxes(0, 1))
    value = played.value[:-1, :, 0].swapaxes(0, 1)
    return Evaluation(episodes.solved, episodes.length, action, value)


def play_greedily(
    agent: Agent, params: Params, env: Environment, tasks: State
) -> tuple[Frame, Trajectory]:
    """The frame in which the agent sees each task, and the episodes in these frames.

    Arguments are those of `evaluate`.
    """
    frame = Frame.of(jnp.zeros(len(tasks.time), jnp.int32))
    if agent.config.align_to_food:
        frame = jax.vmap(Frame.facing_food)(jax.vmap(tt.observe)(tasks))
    seen = jax.vmap(Frame.state)(frame, tasks)
    unused_key = jax.random.key(0)
    return frame, rollout(agent, params, env, seen, unused_key, choose=greedy_action)


class Evaluator:
    """Greedy play on the tasks of several sets, compiled once for any parameters."""

    def __init__(self, config: Config, tasks: Mapping[str, State]):
        """Prepares the play.

        Args:
          config: the settings of the policies to come.
          tasks: the tasks of each set, by name; see `evaluation_tasks`. Where `config.max_steps`
            is None, the names are those of registered sets, whose limits hold.

        Raises:
          ValueError: `config.max_steps` is None, and a name is not that of a registered set.
        """
        self.tasks = dict(tasks)
        self.limits = {name: config.step_limit(name) for name in self.tasks}
        self._total = sum(len(states.time) for states in self.tasks.values())
        together = jax.tree.map(lambda *parts: np.concatenate(parts), *self.tasks.values())
        self._blocks = [take(together, block) for block in blocks(self._total)]
        # All sets are played up to the largest limit; `__call__` cuts off what is beyond a set's.
        longest = max(self.limits.values())
        env = tt.Environment(base=tt.base_state(config.num_features), max_steps=longest)
        agent = Agent(config)
        self._play: Any = jax.jit(lambda params, states: evaluate(agent, params, env, states))

    @classmethod
    def of_sets(cls, config: Config, sets: Sequence[str], num_tasks: int) -> "Evaluator":
        """An evaluator of registered task sets.

        Raises:
          ValueError: unknown set, no set, or no task.
        """
        if not sets:
            raise ValueError(f"name at least one task set; allowed: {', '.join(ALL_SETS)}")
        names = [tt.task_set(name).short for name in sets]
        tasks = {name: evaluation_tasks(name, num_tasks, config.num_features) for name in names}
        return cls(config, tasks)

    def compile(self, params: Params) -> None:
        """Compiles for parameters of these shapes, as the first call would."""
        self._play = self._play.lower(params, self._blocks[0]).compile()

    def __call__(self, params: Params) -> dict[str, Evaluation]:
        """Outcomes as NumPy arrays, by the names of the tasks."""
        played = [jax.tree.map(np.asarray, self._play(params, states)) for states in self._blocks]
        whole = jax.tree.map(lambda *parts: np.concatenate(parts)[: self._total], *played)
        ends = np.cumsum([len(states.time) for states in self.tasks.values()])
        starts = np.concatenate([[0], ends[:-1]])
        return {
            name: _within(take(whole, slice(start, end)), self.limits[name])
            for name, start, end in zip(self.tasks, starts, ends, strict=True)
        }

    def scores(
        self,
        played: Mapping[str, Evaluation],
        shortest: Mapping[str, np.ndarray] | None = None,
    ) -> list[Score]:
        """The score of every set.

        Args:
          played: outcomes by set, as a call returned them.
          shortest: the lengths i32[B] of each set's shortest plans, to compare with.
        """
        made = []
        for name, outcome in played.items():
            solved, length = np.asarray(outcome.solved), np.asarray(outcome.length)
            found = None
            if shortest is not None:
                found = Optimality.of(solved, length, shortest[name], self.limits[name])
            layout = layout_numbers(name, self.tasks[name])
            score = Score.of(name, label(name), solved, length, layout=layout, optimality=found)
            made.append(score)
        return made


def own_and_paper_sets(config: Config) -> tuple[str, ...]:
    """The short names of the paper's eight sets, and of that of training if it is another one."""
    return tuple(dict.fromkeys((*ALL_SETS, tt.task_set(config.env_id).short)))


def _within(outcome: Evaluation, limit: int) -> Evaluation:
    """The episodes as they are if truncated after `limit` steps."""
    return outcome._replace(
        solved=outcome.solved & (outcome.length <= limit),
        length=np.minimum(outcome.length, limit),
    )
