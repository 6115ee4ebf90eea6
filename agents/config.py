"""Every setting of training in one frozen record, and the named presets.

Source of the `paper` preset: agent specification, "PPO", "ICM" and "Network".
"""

import dataclasses
import difflib
from typing import Any, Literal, Self, get_args

Curiosity = Literal["icm", "icm-detached", "rnd", "counts", "none"]
EncoderName = Literal["paper", "objects"]


@dataclasses.dataclass(frozen=True)
class Config:
    """The settings of one training run; the defaults are the paper's.

    Attributes:
      env_id: the task set to train on, by id or short name.
      num_features: N, feature channels of the observation; 3 is RGB.
      max_steps: steps after which an episode is truncated.
      iterations: rollouts to train for, at most.
      stop_when_solved: stop early once the greedy policy solves this share of the
        evaluation tasks of `env_id`; 0 never stops early.
      episodes: episodes per iteration.
      epochs: passes over each iteration's episodes.
      minibatch: whole episodes per gradient step; divides `episodes`.
      discount: gamma.
      gae_lambda: lambda of the advantage estimates.
      clip: half-width of PPO's interval of probability ratios.
      value_coef: weight of the squared error of the value.
      entropy_coef: weight of the entropy bonus, summed over grasp and move.
      learning_rate: Adam's step size.
      cooldown: share of the iterations, the last ones, over which the step size falls
        linearly to nothing.
      adam_epsilon: Adam's epsilon.
      max_gradient_norm: global norm to which gradients are clipped.
      curiosity: source of the intrinsic reward. `icm`: the paper's, forward and inverse
        models over the policy's GRU outputs. `icm-detached`: an encoder of its own, trained
        by the inverse loss alone. `rnd`: imitation of a random network. `counts`: how seldom
        training has seen an observation. `none`: plain PPO.
      intrinsic_scale: weight of the normalised intrinsic reward.
      curiosity_coef: weight of the curiosity's losses.
      episodic_novelty: pay the intrinsic reward only for observations that are new in
        their episode.
      imitation_coef: weight of imitating the agent's own solved episodes; 0 for none.
      imitation_episodes: the newest solved episodes that are remembered and imitated.
      reward_rate: weight of the past in the moving moments that normalise both rewards.
      encoder: `paper`, or `objects`: cells of one colour make an object, and where each is
        seen from agent and food is all that is encoded.
      filters: channels of the first convolutions, and of all later ones; units of the layers
        of `objects`.
      hidden: units of the GRU, of the layer before it and of the inverse model.
      embedding: units of each action embedding and of the reward's.
      eval_episodes: fixed evaluation tasks per task set.
      chunk: distinct observations that are encoded at once; changes speed, not results.
    """

    env_id: str = "TrapTube-v0"
    num_features: int = 3
    max_steps: int = 50
    iterations: int = 250
    stop_when_solved: float = 0.0
    episodes: int = 1024
    epochs: int = 10
    minibatch: int = 128
    discount: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    value_coef: float = 0.01
    entropy_coef: float = 1e-4
    learning_rate: float = 1e-3
    cooldown: float = 0.0
    adam_epsilon: float = 1e-7
    max_gradient_norm: float = 1.0
    curiosity: Curiosity = "icm"
    intrinsic_scale: float = 0.1
    curiosity_coef: float = 10.0
    episodic_novelty: bool = False
    imitation_coef: float = 0.0
    imitation_episodes: int = 16
    reward_rate: float = 0.9
    encoder: EncoderName = "paper"
    filters: tuple[int, int] = (32, 64)
    hidden: int = 64
    embedding: int = 8
    eval_episodes: int = 128
    chunk: int = 64

    def __post_init__(self) -> None:
        """Refuses settings that cannot be trained with.

        Raises:
          ValueError: naming the setting, its value and what is allowed.
        """
        for field in dataclasses.fields(self):
            _check_type(field, getattr(self, field.name))
        for name, (low, high) in _RANGES.items():
            values = getattr(self, name)
            for value in values if isinstance(values, tuple) else (values,):
                if not low <= value <= high:
                    raise ValueError(f"{name} must lie in [{low}, {high}], got {value}")
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in get_args(choices):
                allowed = ", ".join(get_args(choices))
                raise ValueError(f"{name} must be one of {allowed}, got {getattr(self, name)!r}")
        if self.episodes % self.minibatch:
            divisors = [n for n in range(1, self.episodes + 1) if self.episodes % n == 0]
            raise ValueError(
                f"minibatch must divide episodes={self.episodes}, got {self.minibatch}; "
                f"allowed: {', '.join(map(str, divisors))}"
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

    @property
    def transitions(self) -> int:
        """The largest number of environment steps of one iteration."""
        return self.episodes * self.max_steps


_CHOICES = {"curiosity": Curiosity, "encoder": EncoderName}
_INFINITY = float("inf")
_RANGES: dict[str, tuple[float, float]] = {
    "num_features": (1, 256),
    "max_steps": (1, 10_000),
    "iterations": (1, _INFINITY),
    "stop_when_solved": (0, 1),
    "episodes": (1, _INFINITY),
    "epochs": (1, _INFINITY),
    "minibatch": (1, _INFINITY),
    "discount": (0, 1),
    "gae_lambda": (0, 1),
    "clip": (0, _INFINITY),
    "value_coef": (0, _INFINITY),
    "entropy_coef": (0, _INFINITY),
    "learning_rate": (0, _INFINITY),
    "cooldown": (0, 1),
    "adam_epsilon": (0, _INFINITY),
    "max_gradient_norm": (0, _INFINITY),
    "intrinsic_scale": (0, _INFINITY),
    "curiosity_coef": (0, _INFINITY),
    "imitation_coef": (0, _INFINITY),
    "imitation_episodes": (1, _INFINITY),
    "reward_rate": (0, 1),
    "filters": (1, 4096),
    "hidden": (1, 65_536),
    "embedding": (1, 65_536),
    "eval_episodes": (1, _INFINITY),
    "chunk": (1, _INFINITY),
}

PRESETS: dict[str, dict[str, Any]] = {
    "paper": {},
    # Solves the base task in minutes: novelty by counts explores where the prediction error
    # of a shared encoder fades, and imitation holds on to the first successes.
    "fast": {
        "iterations": 100,
        "stop_when_solved": 1.0,
        "episodes": 256,
        "minibatch": 64,
        "epochs": 8,
        "filters": (16, 32),
        "entropy_coef": 3e-3,
        "curiosity": "counts",
        "episodic_novelty": True,
        "intrinsic_scale": 0.3,
        "imitation_coef": 1.0,
    },
    # Trained on {P, St, Sy}: the encoder sees objects instead of colours.
    "best": {
        "env_id": "pstsy",
        "iterations": 800,
        "epochs": 4,
        "curiosity": "none",
        "entropy_coef": 3e-3,
        "encoder": "objects",
        "filters": (64, 64),
        "hidden": 128,
    },
}


def _check_type(field: dataclasses.Field, value: Any) -> None:
    default = field.default
    if isinstance(default, bool) or isinstance(value, bool):
        matches = isinstance(default, bool) and isinstance(value, bool)
    elif isinstance(default, float):
        matches = isinstance(value, int | float)
    elif isinstance(default, tuple):
        matches = (
            isinstance(value, tuple)
            and len(value) == len(default)
            and all(isinstance(item, int) for item in value)
        )
    else:
        matches = isinstance(value, type(default))
    if not matches:
        wanted = "2 integers" if isinstance(default, tuple) else type(default).__name__
        raise ValueError(f"{field.name} must be {wanted}, got {value!r}")
