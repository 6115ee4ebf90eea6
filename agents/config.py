"""Settings of training in one frozen dataclass, and the named presets.

Source of the `paper` preset: agents/agent.md.
"""

import dataclasses
from functools import partial
from typing import Any, Literal, Self, get_args, get_origin

import jax
import numpy as np

import trap_tube_jax as tt
from agents import registry
from trap_tube_jax.checks import did_you_mean
from trap_tube_jax.environment import are_known
from trap_tube_jax.objects import AGENT, FOOD

MAX_INT32 = 2**31 - 1  # the largest i32, in which training counts


def _setting(
    group: str, default: Any, low: float | None = None, high: float = MAX_INT32, **metadata: Any
) -> Any:
    """Declares a field of `Config`: its group, default and, for numbers, inclusive limits."""
    limits = None if low is None else (low, high)
    metadata = {"group": group, "limits": limits, **metadata}
    return dataclasses.field(default=default, metadata=metadata)


_task = partial(_setting, "task")
_length = partial(_setting, "length of training")
_ppo = partial(_setting, "PPO")
_curiosity = partial(_setting, "curiosity")
_replay = partial(_setting, "replay of failed tasks")
_network = partial(_setting, "network")


@dataclasses.dataclass(frozen=True)
class Config:
    """The settings of one training run; defaults are the paper's.

    Attributes:
      env_id: task set to train on, by id or short name, or a mixture such as p+pstsy.
      num_features: feature channels of the observation; 3 is RGB.
      max_steps: step limit of training episodes; None keeps the task set's limit. Evaluation always
        uses the task set's limit.
      iterations: rollouts to train for, at most. Schedules span this number.
      max_transitions: environment steps to train for, at most; training stops before an iteration
        that could exceed it. None sets no limit.
      stop_when_solved: solved fraction at which training stops. Counts the validation tasks of
        `env_id`, played greedily; 0 never stops early.
      eval_episodes: fixed evaluation tasks per task set.
      episodes_per_iteration: episodes played per iteration.
      epochs: passes over the episodes of an iteration.
      minibatch_size: whole episodes per gradient step; divides `episodes_per_iteration`.
      discount: gamma.
      gae_lambda: lambda of the advantage estimates.
      bootstrap: value after an episode's last step. `value`: 0 after termination, the
        last observation's value after truncation; the value target is advantage + value.
        `baseline`, as in the paper's published baseline: the value of the final board after
        termination; step T bootstraps from its own value, even if it terminates; the value target
        is the discounted sum of rewards.
      clip_eps: half-width of PPO's clipping interval.
      value_coef: weight of the squared value error.
      entropy_coef: weight of the entropy bonus. Entropy is summed over grasp and move.
      motion_coef: weight of the motion-prediction loss. 0 trains without its head
        (`agents.ppo.motion`).
      learning_rate: Adam's step size.
      lr_decay_fraction: final fraction of training that decays the step size. It decays
        geometrically towards a fiftieth.
      adam_epsilon: Adam's epsilon.
      max_gradient_norm: largest global norm of a gradient. A larger gradient is scaled down to it.
      curiosity: intrinsic reward, by its registered name. README.md lists them.
      intrinsic_coef: weight of the intrinsic reward. The reward is normalised; with separate value
        heads its advantage is weighted instead.
      intrinsic_coef_init: initial weight, or 0 for a constant one. It decays geometrically to
        `intrinsic_coef`.
      intrinsic_anneal_fraction: fraction of iterations that decay the weight.
      curiosity_coef: weight of the curiosity's losses.
      value_heads: one value head, or one per reward. `shared`: rewards are divided by their
        standard deviation and added, and one head values the sum. `separate`: each reward has its
        own head, and the normalised advantages are added (`agents.ppo.advantages`).
      reward_ema_decay: decay of the moving averages: the variances that scale rewards, and the
        rates of `effects`.
      replay_fractions: fractions of episodes that replay tasks failed once, twice, and so on.
      replay_capacity: failed tasks kept per replay fraction.
      align_to_food: turns the board once per episode, so that the food is below the agent. May also
        mirror it.
      repeat_penalty: penalty on repeats in greedy play. An action loses this many nats for each of
        the last 64 steps that took it at the same observation (`agents.acting.repeats`).
      encoder: paper, objects or a registered name. `objects` groups cells by colour and encodes
        their positions relative to agent and food.
      filters: channels of the convolutions; layer widths of `objects`.
      object_colors: lets `objects` know the colours of base.
      hidden: units of the GRU. The layer before it, and hidden layers of `icm`, `rnd` and `noveld`,
        have as many.
      embedding: units of embeddings of action and reward.
      recurrent: keeps the GRU's state between steps; otherwise the agent remembers only its
        previous action and reward.
      previous_inputs: also reads the previous action and reward.

    Raises:
      ValueError: a setting's value is not allowed; the message names the allowed ones.

    Example:
      >>> config = agents.Config.preset("fast", env_id="sy", iterations=50)
      >>> config.curiosity, config.episodes_per_iteration, config.gradient_steps
      ('effects', 256, 32)
    """

    env_id: str = _task("TrapTube-v0", flags=("--env",))
    num_features: int = _task(3, 1, 256)
    max_steps: int | None = _task(None, 1, 10_000)

    iterations: int = _length(250, 1, 10_000_000)
    max_transitions: int | None = _length(None, 1)
    stop_when_solved: float = _length(0.0, 0, 1)
    eval_episodes: int = _length(128, 1, 1_000_000)

    episodes_per_iteration: int = _ppo(1024, 1, 1_000_000)
    epochs: int = _ppo(10, 1, 10_000)
    minibatch_size: int = _ppo(128, 1, 1_000_000)
    discount: float = _ppo(0.99, 0, 1)
    gae_lambda: float = _ppo(0.95, 0, 1)
    bootstrap: Literal["value", "baseline"] = _ppo("baseline")
    clip_eps: float = _ppo(0.2, 0)
    value_coef: float = _ppo(0.01, 0)
    entropy_coef: float = _ppo(1e-4, 0)
    motion_coef: float = _ppo(0.0, 0)
    learning_rate: float = _ppo(1e-3, 0)
    lr_decay_fraction: float = _ppo(0.0, 0, 1)
    adam_epsilon: float = _ppo(1e-7, 1e-12)
    max_gradient_norm: float = _ppo(1.0, 1e-12)

    curiosity: str = _curiosity("icm")
    intrinsic_coef: float = _curiosity(0.1, 0)
    intrinsic_coef_init: float = _curiosity(0.0, 0)
    intrinsic_anneal_fraction: float = _curiosity(0.3, 0, 1)
    curiosity_coef: float = _curiosity(10.0, 0)
    value_heads: Literal["shared", "separate"] = _curiosity("shared")
    reward_ema_decay: float = _curiosity(0.9, 0, 1)

    replay_fractions: tuple[float, ...] = _replay((), 0, 1, may_be_empty=True)
    replay_capacity: int = _replay(1024, 1, 1_000_000)

    align_to_food: bool = _network(False)
    repeat_penalty: float = _network(0.0, 0)
    encoder: str = _network("paper")
    filters: tuple[int, int] = _network((32, 64), 1, 4096)
    object_colors: bool = _network(False)
    hidden: int = _network(64, 1, 65_536)
    embedding: int = _network(8, 1, 65_536)
    recurrent: bool = _network(True)
    previous_inputs: bool = _network(True)

    def __post_init__(self) -> None:
        """Raises ValueError for an invalid setting, naming its value and the allowed ones."""
        for field in dataclasses.fields(self):
            value = _plain(getattr(self, field.name))
            object.__setattr__(self, field.name, value)
            _check_value(field, value)
        registry.curiosities.factory(self.curiosity)
        registry.encoders.factory(self.encoder)
        if self.object_colors and self.encoder == "paper":
            raise ValueError("object_colors needs encoder='objects', got 'paper'")
        if self.value_heads == "separate" and self.bootstrap != "value":
            raise ValueError(
                f"value_heads='separate' needs bootstrap='value', got {self.bootstrap!r}"
            )
        if self.intrinsic_coef_init and not 0 < self.intrinsic_coef <= self.intrinsic_coef_init:
            raise ValueError(
                f"intrinsic_coef_init must be 0, or at least intrinsic_coef > 0; got "
                f"{self.intrinsic_coef_init} and intrinsic_coef={self.intrinsic_coef}"
            )
        if self.num_new < 1:
            raise ValueError(
                f"replay_fractions must leave at least one of {self.episodes_per_iteration} "
                f"episodes to new tasks, got {self.replay_fractions}"
            )
        episodes = self.episodes_per_iteration
        if episodes % self.minibatch_size:
            divisors = [str(n) for n in range(1, episodes + 1) if episodes % n == 0]
            raise ValueError(
                f"minibatch_size must divide episodes_per_iteration={episodes}, "
                f"got {self.minibatch_size}; allowed: {', '.join(divisors)}"
            )

    @classmethod
    def preset(cls, name: str = "paper", /, **overrides: Any) -> Self:
        """Returns the named preset with single settings replaced.

        Raises:
          ValueError: unknown preset or setting, or a setting's value is not allowed.
        """
        if name not in PRESETS:
            near = did_you_mean(name, PRESETS)
            raise ValueError(f"unknown preset {name!r}{near}; allowed: {', '.join(PRESETS)}")
        return cls.from_dict({**PRESETS[name], **overrides})

    @classmethod
    def from_dict(cls, settings: dict[str, Any]) -> Self:
        """Returns the config with these settings and the paper's defaults; inverts `to_dict`.

        Raises:
          ValueError: unknown setting, or a setting's value is not allowed.
        """
        known = [field.name for field in dataclasses.fields(cls)]
        for name in settings:
            if name not in known:
                near = did_you_mean(name, known)
                raise ValueError(f"unknown setting {name!r}{near}; allowed: {', '.join(known)}")
        return cls(**settings)

    def to_dict(self) -> dict[str, Any]:
        """Returns all settings as plain values, for JSON."""
        return dataclasses.asdict(self)

    def validate(self, env: tt.Environment) -> None:
        """Raises ValueError unless these settings can be trained with in an environment."""
        if not isinstance(env, tt.Environment):
            raise ValueError(f"env must be a trap_tube_jax.Environment, not wrapped, got {env!r}")
        for name in ("num_features", "max_steps"):
            if getattr(self, name) not in (None, getattr(env, name)):
                raise ValueError(
                    f"the environment's {name} is {getattr(env, name)}, the config's "
                    f"{getattr(self, name)}; they must agree"
                )
        if self.align_to_food or self.encoder == "objects":
            _check_known_colors(env)
        longest = self.episodes_per_iteration * env.max_steps
        if self.max_transitions is not None and self.max_transitions < longest:
            raise ValueError(
                f"max_transitions must allow an iteration, which takes up to {longest:,} steps, or "
                f"be None; got {self.max_transitions:,}"
            )
        steps = self.iterations * longest
        if min(steps, self.max_transitions or steps) > MAX_INT32:
            raise ValueError(
                f"iterations={self.iterations} of {self.episodes_per_iteration} episodes of "
                f"{env.max_steps} steps are {steps:,} steps; allowed: at most {MAX_INT32:,}"
            )
        if self.iterations * self.gradient_steps > MAX_INT32:
            raise ValueError(
                f"iterations={self.iterations} of {self.gradient_steps} gradient steps are "
                f"{self.iterations * self.gradient_steps:,}; allowed: at most {MAX_INT32:,}"
            )

    @property
    def step_limit(self) -> int:
        """Step limit of training episodes."""
        return self.max_steps or tt.task_set(self.env_id).max_steps

    @property
    def num_value_heads(self) -> int:
        """V, the number of value heads."""
        return 2 if self.value_heads == "separate" and self.curiosity != "none" else 1

    @property
    def has_schedule(self) -> bool:
        """Tells whether `iterations` decides more than the end of training."""
        anneals = self.curiosity != "none" and bool(self.intrinsic_coef_init)
        anneals = anneals and self.intrinsic_anneal_fraction > 0
        return anneals or self.lr_decay_fraction > 0

    @property
    def num_replayed(self) -> tuple[int, ...]:
        """Episodes of an iteration that replay tasks failed once, twice, and so on."""
        return tuple(round(f * self.episodes_per_iteration) for f in self.replay_fractions)

    @property
    def num_new(self) -> int:
        """Episodes of an iteration that play a newly drawn task."""
        return self.episodes_per_iteration - sum(self.num_replayed)

    @property
    def gradient_steps(self) -> int:
        """Gradient steps of one iteration."""
        return self.epochs * (self.episodes_per_iteration // self.minibatch_size)


EFFECTS_DEFAULTS = {
    "epochs": 4,
    "discount": 0.98,
    "bootstrap": "value",
    "value_coef": 0.5,
    "entropy_coef": 5e-3,
    "curiosity": "effects",
    "value_heads": "separate",
}
PRESETS: dict[str, dict[str, Any]] = {
    "paper": {},
    # Solves the base task within a minute.
    "fast": {
        **EFFECTS_DEFAULTS,
        "iterations": 100,
        "stop_when_solved": 1.0,
        "episodes_per_iteration": 256,
        "minibatch_size": 32,
        "learning_rate": 2e-3,
        "intrinsic_coef": 2.0,
        "filters": (8, 16),
    },
    # Learns {P, St, Sy}: encodes objects, replays failed tasks, predicts motion, avoids repeats.
    "best": {
        **EFFECTS_DEFAULTS,
        "env_id": "pstsy",
        "iterations": 1150,
        "max_transitions": 25_600_000,
        "episodes_per_iteration": 512,
        "minibatch_size": 64,
        "motion_coef": 0.5,
        "lr_decay_fraction": 0.45,
        "intrinsic_coef": 0.03,
        "intrinsic_coef_init": 3.0,
        "intrinsic_anneal_fraction": 0.5,
        "replay_fractions": (0.0625, 0.125, 0.75),
        "align_to_food": True,
        "repeat_penalty": 3.0,
        "encoder": "objects",
        "filters": (64, 64),
        "hidden": 128,
    },
}


def _check_known_colors(env: tt.Environment) -> None:
    """Raises ValueError if agent or food may have another colour than in the base task."""
    known = tt.base_palette(env.num_features)[[AGENT, FOOD]].tolist()
    palettes: Any = [env.base.palette]
    if not are_known(env.transfers):
        states, _ = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 1024))
        palettes = states.palette
    for palette in np.asarray(palettes)[:, [AGENT, FOOD]].tolist():
        if palette != known:
            raise ValueError(
                "align_to_food and encoder='objects' know agent and food by the colours of the "
                f"base task, {known}; in this environment they may be {palette}"
            )


def _plain(value: Any) -> Any:
    """Converts NumPy scalars to Python scalars, and lists, as read from JSON, to tuples."""
    if isinstance(value, np.generic):
        return value.item()
    return tuple(map(_plain, value)) if isinstance(value, list | tuple) else value


def _check_value(field: dataclasses.Field, value: Any) -> None:
    """Raises ValueError for a value that the field's type or limits do not allow."""
    kind = field.type
    if get_origin(kind) is Literal:
        wanted = f"one of {', '.join(get_args(kind))}"
        valid = value in get_args(kind)
    elif kind in (bool, str):
        wanted = "True or False" if kind is bool else "a name"
        valid = type(value) is kind
    else:
        low, high = field.metadata["limits"]
        is_whole = "int" in str(kind)
        wanted = f"{'an integer' if is_whole else 'a finite number'} from {low:,} to {high:,}"
        numbers = (value,)
        valid = True
        if get_origin(kind) is tuple:
            length = 2 if field.name == "filters" else None
            wanted = f"{length or 'a tuple of'} numbers, each {wanted}"
            numbers = value
            valid = type(value) is tuple and len(value) == (length or len(value))
        types = (int,) if is_whole else (int, float)  # `type` tells a bool from an int
        valid = valid and all(type(x) in types and low <= x <= high for x in numbers)
    if not valid and not (value is None and field.default is None):
        raise ValueError(f"{field.name} must be {wanted}, got {value!r}")
