"""Every setting of training in one frozen record, and the named presets.

Source of the `paper` preset: agents/agent.md.
"""

import dataclasses
import difflib
import inspect
import types
from typing import Any, Literal, Self, get_args, get_origin

from agents import registry
from trap_tube_jax.imports import import_modules
from trap_tube_jax.registry import task_set

_NO_LIMIT = float("inf")


def _setting(
    default: Any,
    low: float | None = None,
    high: float = _NO_LIMIT,
    *,
    unused: dict[str, tuple[Any, ...]] | None = None,
) -> Any:
    """A field of `Config` with all that is to be known of it.

    Args:
      default: the paper's value.
      low: smallest value, for numbers.
      high: largest value.
      unused: values of other settings with which this one has no effect.
    """
    limits = None if low is None else (low, high)
    metadata = {"limits": limits, "unused": unused or {}}
    return dataclasses.field(default=default, metadata=metadata)


@dataclasses.dataclass(frozen=True)
class Config:
    """The settings of one training run.

    `Config()` is the preset `paper`. `agents.train` and `agents.sweep` start from the preset
    `fast`.

    Attributes:
      imports: modules of your own, imported first, for the names that they register.
      env_id: the task set to train on, by id or short name.
      num_features: N, feature channels of the observation; 3 is RGB.
      max_steps: steps after which an episode is truncated; None: as many as its set has.

      iterations: rollouts to train for, at most.
      max_transitions: environment steps to train for, at most: an iteration that could take more
        is not begun; None: no limit. What changes as training goes, as the step size in its
        cooldown, follows `iterations`.
      stop_when_solved: stop early once the greedy policy solves this share of the
        evaluation tasks of `env_id`; 0 never stops early.
      eval_episodes: fixed evaluation tasks per task set.

      episodes: episodes per iteration.
      epochs: passes over each iteration's episodes.
      minibatch: whole episodes per gradient step; divides `episodes`.

      discount: gamma.
      gae_lambda: lambda of the advantage estimates.
      bootstrap: what follows the last step of an episode. `value`: nothing after a terminated
        episode, the value of the last observation after a truncated one; the value's target is
        advantage + value. `baseline`: as in the paper's published baseline, the value of the
        board that stays after a terminated episode, and the last step's own value after a
        truncated one; the value's target is the discounted sum of rewards.
      clip: half-width of PPO's interval of probability ratios.
      value_coef: weight of the squared error of the value.
      entropy_coef: weight of the entropy bonus, summed over grasp and move.

      learning_rate: Adam's step size.
      cooldown: share of the gradient steps, the last ones, over which the step size falls
        geometrically to a fiftieth.
      adam_epsilon: Adam's epsilon.
      max_gradient_norm: global norm to which gradients are clipped.

      curiosity: source of the intrinsic reward. `icm`: the paper's, forward and inverse
        models over the policy's GRU outputs. `icm-detached`: an encoder of its own, trained
        by the inverse loss alone. `rnd`: imitation of a random network. `noveld`: where that
        error rises. `ride`: how much a step changes features of the observation. `e3b`: how
        unlike the episode's others they are. `counts`: how seldom training has seen an
        observation. `effects`: the first time in an episode that food or tool come to a cell, or
        that the hand grasps at a colour; what happens seldom pays more. `none`: plain PPO. Or a
        name that you registered.
      intrinsic_scale: weight of the normalised intrinsic reward, or of its advantage.
      intrinsic_start: its weight at first, which falls geometrically to `intrinsic_scale`; 0 for
        a weight that is the same throughout.
      intrinsic_fall: share of the iterations, the first ones, over which it falls.
      curiosity_coef: weight of the curiosity's losses.
      rewards: what becomes of extrinsic and intrinsic reward. `summed`: both are divided by their
        deviation and added; there is one value. `apart`: each has a value of its own, and the
        normalised advantages are added (`agents.ppo.advantages`). In either case the advantages
        are normalised in the end, so that `intrinsic_scale` decides between the two rewards.
      reward_rate: weight of the past in the moving moments that normalise both rewards, and in
        the rates of `effects`.

      replayed: shares of the episodes that play tasks again which were failed once, twice, and
        so on; empty: none.
      failures: how many tasks of each kind, the newest, are kept for that.

      facing: whether the board is turned and mirrored for the agent, once for each episode, so
        that the food lies ahead of it at the start.
      encoder: `paper`, or `objects`: cells of one colour make an object, and where each is
        seen from agent and food is all that is encoded. Or a name that you registered. A
        curiosity that has encoders of its own has them of this kind.
      filters: channels of the first convolution, and of all later ones; units of the layers
        of `objects`.
      hidden: units of the GRU, of the layer before it and of the inverse model.
      embedding: units of each action embedding and of the reward's.
      recurrent: whether the GRU's state lasts. Without, the agent remembers its previous action
        and reward and no more.
      chunk: distinct observations that are encoded at once; changes speed, and results only by
        the order of float32 sums.
      compile_quickly: whether a run's program compiles in two thirds of the time, for short runs
        on a CPU; changes speed, and results only by rounding.
    """

    imports: tuple[str, ...] = _setting(())
    # The task.
    env_id: str = _setting("TrapTube-v0")
    num_features: int = _setting(3, 1, 256)
    max_steps: int | None = _setting(None, 1, 10_000)
    # How long, and how it is judged.
    iterations: int = _setting(250, 1)
    max_transitions: int | None = _setting(None, 1)
    stop_when_solved: float = _setting(0.0, 0, 1)
    eval_episodes: int = _setting(128, 1)
    # Episodes and gradient steps of an iteration.
    episodes: int = _setting(1024, 1)
    epochs: int = _setting(10, 1)
    minibatch: int = _setting(128, 1)
    # PPO.
    discount: float = _setting(0.99, 0, 1)
    gae_lambda: float = _setting(0.95, 0, 1)
    bootstrap: Literal["value", "baseline"] = _setting("baseline")
    clip: float = _setting(0.2, 0)
    value_coef: float = _setting(0.01, 0)
    entropy_coef: float = _setting(1e-4, 0)
    # The optimizer.
    learning_rate: float = _setting(1e-3, 0)
    cooldown: float = _setting(0.0, 0, 1)
    adam_epsilon: float = _setting(1e-7, 1e-12)
    max_gradient_norm: float = _setting(1.0, 0)
    # Intrinsic reward.
    curiosity: str = _setting("icm")
    intrinsic_scale: float = _setting(0.1, 0, unused={"curiosity": ("none",)})
    intrinsic_start: float = _setting(0.0, 0, unused={"curiosity": ("none",)})
    intrinsic_fall: float = _setting(0.3, 0, 1, unused={"intrinsic_start": (0,)})
    curiosity_coef: float = _setting(10.0, 0, unused={"curiosity": ("none", "counts", "effects")})
    rewards: Literal["summed", "apart"] = _setting("summed", unused={"curiosity": ("none",)})
    reward_rate: float = _setting(0.9, 0, 1)
    # Failed tasks, played again.
    replayed: tuple[float, ...] = _setting((), 0, 1)
    failures: int = _setting(1024, 1, unused={"replayed": ((),)})
    # The network.
    facing: bool = _setting(False)
    encoder: str = _setting("paper")
    filters: tuple[int, int] = _setting((32, 64), 1, 4096)
    hidden: int = _setting(64, 1, 65_536)
    embedding: int = _setting(8, 1, 65_536)
    recurrent: bool = _setting(True)
    chunk: int = _setting(64, 1)
    # The machine.
    compile_quickly: bool = _setting(False)

    def __post_init__(self) -> None:
        """Refuses settings that cannot be trained with.

        Raises:
          ValueError: naming the setting, its value and what is allowed.
        """
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            _check_value(field, value)
        import_modules(self.imports)
        registry.curiosities.factory(self.curiosity)
        registry.encoders.factory(self.encoder)
        for field in dataclasses.fields(self):
            self._check_use(field)
        if self.rewards == "apart" and self.bootstrap != "value":
            raise ValueError(f"rewards='apart' needs bootstrap='value', got {self.bootstrap!r}")
        if self.intrinsic_start and not self.intrinsic_scale:
            raise ValueError("intrinsic_start > 0 needs intrinsic_scale > 0, to fall to; got 0")
        if 0 < self.intrinsic_start < self.intrinsic_scale:
            raise ValueError(
                f"intrinsic_start must be 0, or at least intrinsic_scale={self.intrinsic_scale}, "
                f"to which it falls; got {self.intrinsic_start}"
            )
        if self.num_new < 1:
            raise ValueError(
                f"replayed must leave at least one of {self.episodes} episodes to new tasks, got "
                f"shares {self.replayed}, which are {sum(self.num_replayed)} episodes"
            )
        if self.max_transitions is not None and self.max_transitions < self.longest_iteration:
            raise ValueError(
                f"max_transitions must allow an iteration, which takes up to "
                f"{self.longest_iteration:,} steps, or be None; got {self.max_transitions:,}"
            )
        if self.episodes % self.minibatch:
            divisors = [n for n in range(1, self.episodes + 1) if self.episodes % n == 0]
            raise ValueError(
                f"minibatch must divide episodes={self.episodes}, got {self.minibatch}; "
                f"allowed: {', '.join(map(str, divisors))}"
            )

    def _check_use(self, field: dataclasses.Field) -> None:
        """Refuses a setting without effect, unless a preset has brought its value along."""
        value = getattr(self, field.name)
        usual = [field.default, *(p[field.name] for p in PRESETS.values() if field.name in p)]
        if value in usual:
            return
        for name, values in field.metadata["unused"].items():
            if getattr(self, name) in values:
                raise ValueError(
                    f"{field.name}={value!r} has no effect with {name}={getattr(self, name)!r}; "
                    f"leave it at {field.default!r}"
                )

    @classmethod
    def preset(cls, name: str = "paper", **overrides: Any) -> Self:
        """The named preset with single settings replaced.

        Raises:
          ValueError: unknown preset or setting, or a setting's value is not allowed.
        """
        if name not in PRESETS:
            raise ValueError(f"unknown preset {name!r}; allowed: {', '.join(PRESETS)}")
        return cls.from_dict({**PRESETS[name], **overrides})

    @classmethod
    def from_dict(cls, settings: dict[str, Any]) -> Self:
        """The config with these settings, the paper's elsewhere; the inverse of `to_dict`.

        Raises:
          ValueError: unknown setting, or a setting's value is not allowed.
        """
        known = [field.name for field in dataclasses.fields(cls)]
        for name in settings:
            if name not in known:
                near = difflib.get_close_matches(name, known, n=1)
                hint = f"; did you mean {near[0]!r}?" if near else ""
                raise ValueError(f"unknown setting {name!r}{hint}; allowed: {', '.join(known)}")
        values: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in settings.items()
        }
        return cls(**values)

    def to_dict(self) -> dict[str, Any]:
        """All settings as plain values, for JSON."""
        return dataclasses.asdict(self)

    def step_limit(self, name: str) -> int:
        """The steps after which an episode of a task set is truncated.

        Raises:
          ValueError: `max_steps` leaves it to the set, and there is no such set.
        """
        return task_set(name).max_steps if self.max_steps is None else self.max_steps

    @property
    def streams(self) -> int:
        """V, how many streams of rewards have a value each."""
        return 2 if self.rewards == "apart" and self.curiosity != "none" else 1

    @property
    def num_replayed(self) -> tuple[int, ...]:
        """How many episodes of an iteration play tasks again that were failed once, twice, ..."""
        return tuple(round(share * self.episodes) for share in self.replayed)

    @property
    def num_new(self) -> int:
        """How many episodes of an iteration play a task for the first time."""
        return self.episodes - sum(self.num_replayed)

    @property
    def longest_iteration(self) -> int:
        """The environment steps of an iteration in which no episode ends early."""
        return self.episodes * self.step_limit(self.env_id)

    @property
    def gradient_steps(self) -> int:
        """The number of gradient steps of one iteration."""
        return self.epochs * (self.episodes // self.minibatch)


PRESETS: dict[str, dict[str, Any]] = {
    "paper": {},
    # Solves the base task within a minute or so: new effects are paid.
    "fast": {
        "iterations": 100,
        "stop_when_solved": 1.0,
        "episodes": 256,
        "epochs": 4,
        "minibatch": 32,
        "discount": 0.98,
        "bootstrap": "value",
        "value_coef": 0.5,
        "entropy_coef": 5e-3,
        "learning_rate": 2e-3,
        "curiosity": "effects",
        "intrinsic_scale": 2.0,
        "rewards": "apart",
        "filters": (8, 16),
        "compile_quickly": True,
    },
    # Trained on {P, St, Sy}: new effects are paid, failed tasks played again, and the encoder
    # sees objects instead of colours, the food ahead.
    "best": {
        "env_id": "pstsy",
        "iterations": 1150,
        "max_transitions": 25_600_000,
        "episodes": 512,
        "epochs": 4,
        "minibatch": 64,
        "discount": 0.98,
        "bootstrap": "value",
        "value_coef": 0.5,
        "entropy_coef": 5e-3,
        "cooldown": 0.45,
        "curiosity": "effects",
        "intrinsic_scale": 0.03,
        "intrinsic_start": 3.0,
        "intrinsic_fall": 0.8,
        "rewards": "apart",
        "replayed": (0.0625, 0.125, 0.75),
        "facing": True,
        "encoder": "objects",
        "filters": (64, 64),
        "hidden": 128,
        "chunk": 256,
    },
}


def _check_value(field: dataclasses.Field, value: Any) -> None:
    if not _fits(field.type, value):
        wanted = inspect.formatannotation(field.type)
        if get_origin(field.type) is Literal:
            wanted = f"one of {', '.join(get_args(field.type))}"
        raise ValueError(f"{field.name} must be {wanted}, got {value!r}")
    if field.metadata["limits"] is not None and value is not None:
        low, high = field.metadata["limits"]
        for number in value if isinstance(value, tuple) else (value,):
            if not low <= number <= high:
                raise ValueError(f"{field.name} must lie in [{low}, {high}], got {number}")


def _fits(kind: Any, value: Any) -> bool:
    """Whether a value is of an annotated type. An integer is a float too, a bool is neither."""
    kinds = get_args(kind)
    if get_origin(kind) is Literal:
        return value in kinds
    if isinstance(kind, types.UnionType):
        return any(_fits(each, value) for each in kinds)
    if get_origin(kind) is tuple:
        if not isinstance(value, tuple):
            return False
        if kinds[-1] is ...:
            kinds = kinds[:1] * len(value)
        return len(kinds) == len(value) and all(map(_fits, kinds, value))
    if isinstance(value, bool):
        return kind is bool
    return isinstance(value, int | float if kind is float else kind)
