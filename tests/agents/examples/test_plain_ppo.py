"""The plain program computes the losses of `agents.ppo`, and learns."""

import chex
import jax
import jax.numpy as jnp
import pytest

from agents import Config, make_learner
from agents.examples import plain_ppo
from agents.examples.near_food import NEAR_FOOD

pytestmark = pytest.mark.usefixtures("plain_path")

CONFIG = Config(
    env_id=NEAR_FOOD.id,
    episodes_per_iteration=32,
    minibatch_size=32,
    epochs=1,
    filters=(3, 4),
    hidden=5,
    embedding=2,
)


def plain_params(params):
    """The parameters of `agents.ppo` under the names of the plain network."""
    names = ("encoder", "core", "heads", "curiosity")
    encoder, core, heads, icm = (params[name]["params"] for name in names)
    update, reset, candidate = zip(
        *(jnp.split(core[name], 3, axis=-1) for name in ("input_kernel", "state_kernel", "bias")),
        strict=True,
    )
    gates = {"z": update, "r": reset, "n": candidate}
    gru = {f"i{g}": {"kernel": x, "bias": b[0]} for g, (x, _, b) in gates.items()}
    gru |= {f"h{g}": {"kernel": h} for g, (_, h, _) in gates.items()}
    gru["hn"]["bias"] = candidate[2][1]

    def pair(layers, prefix=""):
        grasp = layers[f"{prefix}grasp"]
        move = layers[f"{prefix}move"]
        return {name: jnp.stack([grasp[name], move[name]], axis=-2) for name in ("kernel", "bias")}

    blocks = [encoder[block][conv] for block in ("block1", "block2") for conv in ("conv1", "conv2")]
    convolutions = [encoder["conv1"], encoder["conv2"], *blocks]
    return {
        "params": {
            "encoder": {f"Conv_{i}": layer for i, layer in enumerate(convolutions)},
            "grasp": core["grasp_embedding"],
            "move": core["move_embedding"],
            "reward": core["reward_embedding"],
            "mix": core["mix"],
            "initial": core["initial"],
            "gru": gru,
            "policy": pair(heads),
            "critic": heads["value"],
            "forward": icm["forward"],
            "inverse": {"layers_0": icm["inverse"], "layers_2": pair(icm, "inverse_")},
        }
    }


def test_rewards_advantages_and_losses_equal_the_learners():
    learner = make_learner(CONFIG)
    plain = plain_ppo.PlainPPO(CONFIG)
    state = jax.jit(learner.init)(jax.random.key(0))

    @jax.jit
    def play(state):
        reset_keys = jax.random.split(jax.random.key(1), CONFIG.episodes_per_iteration)
        trajectory = learner.play(state.params, reset_keys, jax.random.key(2))
        reward, _ = learner.intrinsic_reward(state, trajectory)
        return trajectory, learner.make_batch(state, trajectory, reward)

    trajectory, (batch, moments) = play(state)
    episodes = trajectory.episodes
    assert 0 < episodes.mask.mean() < 1, "some end early"
    # Updated parameters, so that ratios are not 1.
    noise = iter(jax.random.split(jax.random.key(3), len(jax.tree.leaves(state.params))))
    now = jax.tree.map(lambda x: x + 0.1 * jax.random.normal(next(noise), x.shape), state.params)
    now["core"]["params"]["bias"] = now["core"]["params"]["bias"].at[1, : 2 * CONFIG.hidden].set(0)
    _, expected = jax.jit(learner.loss)(now, batch)

    steps = (
        episodes.action,
        episodes.reward,
        episodes.mask,
        trajectory.log_prob,
        trajectory.value[:, :-1, 0],
    )
    start = jax.jit(plain.init)(jax.random.key(0))

    def translated(params):  # in 64 bits where the plain program computes in these
        return jax.tree.map(
            lambda x, like: x.astype(like.dtype), plain_params(params), start.params
        )

    plain_state = start.replace(params=translated(state.params))
    variance, (episode, advantage, target) = jax.jit(plain.prepare)(
        plain_state, plain_ppo.Episode(episodes.observations(), *steps)
    )
    total, terms = jax.jit(plain.loss)(translated(now), (episode, advantage, target))
    chex.assert_trees_all_close(
        [variance, advantage, target[..., None], {**terms, "loss": total}],
        [
            moments,
            batch.advantage,
            batch.value_target,
            {name: expected[name] for name in ("loss", *terms)},
        ],
        rtol=1e-4,
        atol=1e-5,
    )


@pytest.mark.slow
def test_an_update_lowers_the_loss():
    plain = plain_ppo.PlainPPO(CONFIG)
    state = jax.jit(plain.init)(jax.random.key(0))
    state, batch, minibatches = jax.jit(plain.collect)(state)
    after, terms = jax.jit(plain.update)(state, batch, minibatches[0])
    assert jax.jit(plain.loss)(after.params, batch)[0] < sum(terms.values())


@pytest.mark.slow
def test_learns_to_reach_near_food(capsys):
    assert plain_ppo.main(iterations=10) > 0.9
    assert capsys.readouterr().out.count("solved") == 10
