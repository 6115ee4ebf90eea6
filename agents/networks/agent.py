"""The agent: policy network and curiosity together, as pure functions of parameters."""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from agents.config import Config
from agents.curiosity.modules import ICM, RND, DetachedICM, Prediction, Transition
from agents.networks.core import Core, Heads, Outputs, draw
from agents.networks.encoder import Encoder, encode_by_windows
from agents.networks.object_encoder import ObjectEncoder
from trap_tube_jax.objects import BOARD_SIZE

Params = dict[str, Any]


class Agent:
    """The functions of a network; holds its modules, never parameters.

    Parameters are a dictionary: `encoder`, `core`, `heads` and, with a curiosity,
    `curiosity`. Features are those of the policy's encoder followed by the curiosity's own.
    """

    def __init__(self, config: Config):
        encoders = {"paper": Encoder, "objects": ObjectEncoder}
        self.encoder = encoders[config.encoder](config.filters)
        self.core = Core(config.hidden, config.embedding)
        self.heads = Heads()
        self.curiosity = _make_curiosity(config)
        self._num_features = config.num_features
        self._policy_width = self._width_of_encoder()
        self._hidden = config.hidden
        self._action_width = 2 * config.embedding

    def init(self, key: jax.Array) -> Params:
        """Fresh parameters."""
        return draw(key, self._deviations())

    def _width_of_encoder(self) -> int:
        board = jnp.zeros((1, BOARD_SIZE, BOARD_SIZE, self._num_features), jnp.uint8)
        features, _ = jax.eval_shape(self.encoder.init_with_output, jax.random.key(0), board)
        return features.shape[-1]

    def _deviations(self) -> Params:
        """The deviation of every parameter; the modules' own keys are not used."""
        key = jax.random.key(0)
        observation = jnp.zeros((1, BOARD_SIZE, BOARD_SIZE, self._num_features), jnp.uint8)
        embedding = jnp.zeros((1, self._hidden))
        params: Params = {
            "encoder": self.encoder.init(key, observation),
            "core": self.core.init(key, method=_touch_core, width=self._policy_width),
            "heads": self.heads.init(key, embedding),
        }
        if self.curiosity is not None:
            action = jnp.zeros((1, 2), jnp.int32)
            action_embedding = jnp.zeros((1, self._action_width))
            params["curiosity"] = self.curiosity.init(
                key,
                observation,
                (embedding, embedding, action_embedding, action),
                method=_touch_curiosity,
            )
        return params

    def encode(self, params: Params, observation: jax.Array) -> jax.Array:
        """Features f32[M, F] of observations u8[M, 12, 12, N]; needs `encoding_params` only."""
        return self.encode_rows(params, observation, None)[0]

    def encode_rows(
        self, params: Params, observation: jax.Array, remembered: Any
    ) -> tuple[jax.Array, Any]:
        """The features, and what `distinct.map_rows` may remember of them."""
        if isinstance(self.encoder, Encoder):
            features, remembered = encode_by_windows(
                self.encoder, params["encoder"], observation, remembered
            )
        else:
            features, remembered = _apply(self.encoder, params["encoder"], observation), None
        if self.curiosity is not None:
            own = _apply(self.curiosity, params["curiosity"], observation, method="encode")
            features = jnp.concatenate([features, own], axis=-1)
        return features, remembered

    def encoding_params(self, params: Params) -> Params:
        """The part of the parameters that `encode` reads."""
        return {name: params[name] for name in ("encoder", "curiosity") if name in params}

    def core_inputs(
        self, params: Params, features: jax.Array, action_tm1: jax.Array, reward_tm1: jax.Array
    ) -> jax.Array:
        """The GRU's inputs f32[..., 3 * hidden]; see `Core.inputs`."""
        features = features[..., : self._policy_width]
        return _apply(
            self.core, params["core"], features, action_tm1, reward_tm1, method=Core.inputs
        )

    def initial_state(self, params: Params, batch: int) -> jax.Array:
        """The GRU's state f32[batch, hidden] before the first step."""
        return _apply(self.core, params["core"], batch, method=Core.initial_state)

    def advance(self, params: Params, state: jax.Array, inputs: jax.Array) -> jax.Array:
        """One step of the GRU; see `Core.advance`."""
        return _apply(self.core, params["core"], state, inputs, method=Core.advance)

    def act(self, params: Params, embedding: jax.Array) -> Outputs:
        """Logits and value of an embedding f32[..., hidden]."""
        return _apply(self.heads, params["heads"], embedding)

    def unroll(
        self, params: Params, features: jax.Array, action: jax.Array, reward: jax.Array
    ) -> jax.Array:
        """The GRU's outputs h at every step, f32[T, B, hidden].

        Args:
          params: the parameters.
          features: f32[T + 1, B, F].
          action: i32[T, B, 2].
          reward: f32[T, B].
        """
        inputs = self._unroll_inputs(params, features, action, reward)[:-1]
        return _apply(self.core, params["core"], inputs, method=Core.unroll)

    def unroll_both(
        self, params: Params, features: jax.Array, action: jax.Array, reward: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """The GRU's outputs at every step and after it, as curiosity compares them.

        The second sequence starts from the initial state at the second observation, with
        the action and reward just taken as the previous ones.

        Args:
          params: the parameters.
          features: f32[T + 1, B, F].
          action: i32[T, B, 2].
          reward: f32[T, B].

        Returns:
          h and h', each f32[T, B, hidden].
        """
        inputs = self._unroll_inputs(params, features, action, reward)
        both = jnp.concatenate([inputs[:-1], inputs[1:]], axis=1)
        embeddings = _apply(self.core, params["core"], both, method=Core.unroll)
        now, after = jnp.split(embeddings, 2, axis=1)
        return now, after

    def _unroll_inputs(
        self, params: Params, features: jax.Array, action: jax.Array, reward: jax.Array
    ) -> jax.Array:
        """The GRU's inputs at all observations, f32[T + 1, B, 3 * hidden]."""
        action_tm1 = jnp.concatenate([jnp.zeros_like(action[:1]), action])
        reward_tm1 = jnp.concatenate([jnp.zeros_like(reward[:1]), reward])
        return self.core_inputs(params, features, action_tm1, reward_tm1)

    def predict(
        self,
        params: Params,
        embedding: jax.Array,
        next_embedding: jax.Array,
        features: jax.Array,
        action: jax.Array,
    ) -> Prediction:
        """What the curiosity, which must exist, says of every step.

        Args:
          params: the parameters.
          embedding: h, f32[T, B, hidden].
          next_embedding: h', f32[T, B, hidden].
          features: f32[T + 1, B, F].
          action: i32[T, B, 2].
        """
        own = features[..., self._policy_width :]
        transition = Transition(
            embedding=embedding,
            next_embedding=next_embedding,
            action_embedding=_apply(self.core, params["core"], action, method=Core.embed_action),
            features=own[:-1],
            next_features=own[1:],
            action=action,
        )
        return _apply(self.curiosity, params["curiosity"], transition, method="predict")


def num_parameters(params: Params) -> int:
    """The number of scalars in `params`."""
    return sum(leaf.size for leaf in jax.tree.leaves(params))


def _apply(module: nn.Module | None, *args: Any, **kwargs: Any) -> Any:
    """`module.apply`, whose static type says nothing of what it returns."""
    if module is None:
        raise ValueError("the config's curiosity is 'none': there is nothing to predict")
    return module.apply(*args, **kwargs)


def _make_curiosity(config: Config) -> nn.Module | None:
    return {
        "icm": lambda: ICM(config.hidden),
        "icm-detached": lambda: DetachedICM(config.hidden, config.filters),
        "rnd": lambda: RND(config.hidden, config.filters),
        "counts": lambda: None,
        "none": lambda: None,
    }[config.curiosity]()


def _touch_core(core: Core, width: int) -> jax.Array:
    """Uses every parameter of the core once, so that all get initialised."""
    action, reward = jnp.zeros((1, 2), jnp.int32), jnp.zeros(1)
    return core.advance(core.initial_state(1), core.inputs(jnp.zeros((1, width)), action, reward))


def _touch_curiosity(curiosity: Any, observation: jax.Array, transition: Any) -> Prediction:
    embedding, next_embedding, action_embedding, action = transition
    features = curiosity.encode(observation)
    return curiosity.predict(
        Transition(embedding, next_embedding, action_embedding, features, features, action)
    )
