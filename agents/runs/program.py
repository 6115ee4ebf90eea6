"""The program shared by runs that differ only in their seed: learner, devices, evaluators."""

import functools
import zlib
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

import trap_tube_jax as tt
from agents.acting.evaluation import evaluate
from agents.acting.policy import Policy
from agents.arrays import from_arrays, to_arrays
from agents.config import Config
from agents.networks.agent import PARTS
from agents.parallel.devices import Placement
from agents.ppo.learner import Learner, TrainState, make_learner
from agents.runs.evaluator import Evaluator, default_sets
from agents.runs.run import RunOptions

Advance = Callable[[TrainState], tuple[TrainState, dict[str, jax.Array]]]
Metrics = dict[str, np.ndarray]
Tree = TypeVar("Tree")


class Program:
    """Holds what is shared by runs that differ only in their seed.

    Attributes:
      options: options of the runs.
      placement: devices of a run.
      learner: the functions of training.
      sets: short names of the task sets to evaluate on.
      validation: evaluator that selects the best policy; None without selection.
      state_shapes: shapes of a training state.
    """

    def __init__(self, config: Config, options: RunOptions):
        """Compiles nothing yet.

        Raises:
          ValueError: the settings, or the devices, cannot be trained with.
        """
        self.config = config
        self.options = options
        self.placement = Placement.of(options.devices, config)
        self.learner = make_learner(config, axis=self.placement.axis)
        names = options.sets or default_sets(config)
        self.sets = tuple(tt.task_set(name).short for name in names)
        self.validation = None
        if options.evaluate_every:
            tasks = config.eval_episodes
            self.validation = Evaluator.of_sets(config, self.sets, tasks, "validation")
        self._init = jax.jit(self.learner.init)  # compiled once for all seeds
        self.state_shapes = jax.eval_shape(self._init, jax.random.key(0))

    @functools.cached_property
    def test(self) -> Evaluator:
        """Evaluator of the reported scores."""
        tasks = self.options.test_tasks or self.config.eval_episodes
        return Evaluator.of_sets(self.config, self.sets, tasks)

    @property
    def num_parameters(self) -> int:
        """Number of parameters, those of fixed networks included."""
        return sum(leaf.size for leaf in jax.tree.leaves(self.state_shapes.params))

    def init(self, seed: int, start: Policy | None = None) -> TrainState:
        """Returns the first state of a run, with the parameters of `start` if it is fine-tuned.

        Raises:
          ValueError: the network of `start` has other shapes.
        """
        key = jax.random.key(seed)
        if start is None:
            return self._init(key)
        arrays = to_arrays(start.params)
        # Even with the same seed, fine-tuning draws other tasks than the training of `start`.
        checksum = zlib.crc32(b"".join(array.tobytes() for array in arrays.values()))
        state = self._init(jax.random.fold_in(key, np.uint32(checksum)))
        try:
            params = from_arrays(arrays, {part: state.params[part] for part in PARTS})
        except ValueError as error:
            old, new = start.config.to_dict(), self.config.to_dict()
            changed = [f"{x}={old[x]}, not {new[x]}" for x in old if old[x] != new[x]]
            raise ValueError(
                f"the agent to fine-tune has another network: {error}; settings that differ: "
                f"{', '.join(changed)}"
            ) from error
        return state._replace(params={**state.params, **params})


class Cohort:
    """The states of one or several seeds, which a compiled program advances together.

    The states of several are stacked along a first axis, and `jax.vmap` makes one program of them;
    a single run uses its learner's program. A member that has ended is advanced as before,
    since another program would have to be compiled for fewer.
    """

    def __init__(self, program: Program, states: Sequence[TrainState]):
        """Compiles the program; the first `advance` donates `states`."""
        self.size = len(states)
        self.placement = program.placement
        advance = make_advance(program.learner)
        if self.size == 1:
            advance = self.placement.shard(advance)
            self.states = self.placement.put(states[0])
        else:
            advance = jax.vmap(advance)
            self.states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
        self._advance = jax.jit(advance, donate_argnums=0).lower(self.states).compile()

    def advance(self) -> Metrics:
        """Trains every member for an iteration; returns their metrics as NumPy arrays."""
        self.states, metrics = self._advance(self.states)
        return jax.tree.map(np.asarray, self.placement.local(metrics))

    def member(self, tree: Tree, index: int) -> Tree:
        """Returns a member's part of states or metrics."""
        if self.size == 1:
            return tree

        def row(leaf: Any) -> Any:
            if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
                leaf = jax.random.clone(leaf)  # a member may be read more than once
            return leaf[index]

        return jax.tree.map(row, tree)

    def state(self, index: int) -> TrainState:
        """Returns the current state of a member."""
        return self.member(self.states, index)


def make_advance(learner: Learner) -> Advance:
    """Returns a function that trains for one iteration and plays the validation tasks greedily.

    The metrics include `validation_success`, bool[B], whether each task is solved within the step
    limit of the task set.
    """
    config = learner.config
    env = tt.make(config.env_id, num_features=config.num_features)
    tasks = tt.evaluation_tasks(
        config.env_id, config.eval_episodes, config.num_features, "validation"
    )

    def advance(state: TrainState) -> tuple[TrainState, dict[str, jax.Array]]:
        after, metrics = learner.iterate(state)
        outcome = evaluate(learner.agent, after.params, env, tasks, learner.encoding)
        return after, {
            **metrics,
            "validation_success": outcome.solved,
            "episodes": after.iteration * config.episodes_per_iteration,
            "transitions": after.transitions,
            "steps": after.transitions - state.transitions,
        }

    return advance
