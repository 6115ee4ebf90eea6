"""The paper preset is the published baseline: one recorded batch, from outputs to updates."""

from typing import Any

import jax
import numpy as np
import optax
import pytest

from agents import Config
from agents.curiosity.icm import ICM
from agents.ppo.learner import make_learner
from agents.ppo.optimizer import BETA1
from helpers.paths import DATA
from helpers.reference_update import Recording, make_trajectory

CONFIG = Config.preset("paper", episodes_per_iteration=8, minibatch_size=8, epochs=5)


@pytest.fixture(scope="module")
def recording() -> Recording:
    with np.load(DATA / "reference_update.npz") as file:
        return Recording({name: file[name] for name in file.files})


@pytest.fixture(scope="module")
def ours(recording: Recording) -> dict[str, Any]:
    learner = make_learner(CONFIG)
    state = learner.init(jax.random.key(0))
    params = recording.params("param", state.params)

    @jax.jit
    def run(params):
        trajectory = make_trajectory(learner.agent, params, recording)
        experience = learner.experience(params, trajectory.episodes)
        prediction = ICM(CONFIG).predict(params["curiosity"], experience)
        before = state._replace(params=params)
        raw, _ = learner.intrinsic_reward(before, trajectory)
        batch, moments = learner.make_batch(before, trajectory, raw)
        return trajectory, experience, prediction, raw, batch, moments

    names = ("trajectory", "experience", "prediction", "raw", "batch", "moments")
    return {"learner": learner, "params": params, **dict(zip(names, run(params), strict=True))}


@pytest.fixture(scope="module")
def updates(ours: dict[str, Any]) -> list[dict[str, Any]]:
    learner = ours["learner"]
    batch = ours["batch"]

    @jax.jit
    def update(params, opt_state):
        gradient, terms = jax.grad(learner.loss, has_aux=True)(params, batch)
        step, opt_state = learner.optimizer.update(gradient, opt_state, params)
        params = optax.apply_updates(params, step)
        return params, opt_state, {**terms, "gradient_norm": optax.tree.norm(gradient)}

    params = ours["params"]
    opt_state = jax.jit(learner.optimizer.init)(ours["params"])
    done = []
    for _ in range(5):
        params, opt_state, terms = update(params, opt_state)
        done.append({"params": params, "moment": opt_state[1].mu, "terms": terms})
    return done


def assert_close(actual: Any, expected: Any) -> None:
    """Leaves are equal within 1e-4 of the largest magnitude of the expected one."""
    leaves = jax.tree_util.tree_leaves_with_path(expected)
    for (path, want), got in zip(leaves, jax.tree.leaves(actual), strict=True):
        scale = np.abs(want).max()
        name = jax.tree_util.keystr(path)
        np.testing.assert_allclose(
            np.asarray(got) / scale, np.asarray(want) / scale, rtol=0, atol=1e-4, err_msg=name
        )


def test_the_network_has_the_published_number_of_parameters(ours):
    assert sum(leaf.size for leaf in jax.tree.leaves(ours["params"])) == 202_113


def test_replayed_boards_are_the_recorded_ones(recording, ours):
    boards = jax.jit(lambda episodes: episodes.observations())(ours["trajectory"].episodes)
    np.testing.assert_array_equal(boards, recording["batch/observation_rgb"])


def test_network_outputs_equal_the_recorded_ones(recording, ours):
    trajectory = ours["trajectory"]
    (error, inferred) = ours["prediction"]
    hidden = ours["experience"].hidden
    actions, _ = ours["learner"].agent.policy_and_value(ours["params"], hidden)
    assert_close(hidden, recording["out/embedding"])
    assert_close(trajectory.log_prob, recording["out/log_probs"])
    assert_close(actions.entropy(), recording["out/entropy"])
    assert_close(trajectory.value[:, :-1, 0], recording["out/values"])
    assert_close(ours["experience"].next_hidden, recording["out/embedding_next"])
    expected = recording["out/embedding_next_pred"] - recording["out/embedding_next"]
    assert_close(error, np.square(expected))
    predicted = [recording[f"out/{name}_pred"] for name in ("move", "grasp")]
    assert_close(jax.nn.softmax(inferred.logits), np.stack(predicted, axis=-2))


def test_rewards_and_targets_equal_the_recorded_ones(recording, ours):
    extrinsic_std, intrinsic_std = np.sqrt(ours["moments"])
    mask = recording["batch/weight"]
    raw = ours["raw"]
    assert_close(raw * mask, recording["reward/intrinsic"] * mask)
    assert_close(extrinsic_std, recording["reward/extrinsic_std"])
    assert_close(intrinsic_std, recording["reward/intrinsic_std"])
    reward = ours["trajectory"].episodes.reward / extrinsic_std
    reward = reward + CONFIG.intrinsic_coef * raw * mask / intrinsic_std
    assert_close(reward, recording["reward/total"] * mask)
    assert_close(ours["batch"].advantage, recording["target/advantages"] * mask)
    assert_close(ours["batch"].value_target[..., 0] * mask, recording["target/returns"] * mask)


@pytest.mark.parametrize("index", range(5))
def test_loss_terms_and_gradient_norm_equal_the_recorded_ones(recording, updates, index):
    terms = updates[index]["terms"]
    prefix = f"update{index + 1}"
    expected = {
        "value_loss": recording[f"{prefix}/loss/value"],
        "entropy_loss": recording[f"{prefix}/loss/entropy"],
        "forward_loss": 10 * recording[f"{prefix}/loss/forward"],
        "inverse_loss": 10 * recording[f"{prefix}/loss/inverse"],
        "gradient_norm": recording[f"{prefix}/gradient_norm"],
    }
    for name, value in expected.items():
        np.testing.assert_allclose(terms[name], value, rtol=1e-4, err_msg=name)
    # The policy's loss is a difference of near-equal sums: compared on the advantages' scale.
    np.testing.assert_allclose(terms["policy_loss"], recording[f"{prefix}/loss/policy"], atol=1e-5)


def test_adam_gets_the_recorded_clipped_gradient(recording, ours, updates):
    expected = recording.params("clipped_gradient1", ours["params"])
    clipped = jax.tree.map(lambda moment: moment / (1 - BETA1), updates[0]["moment"])
    assert_close(clipped, expected)


@pytest.mark.parametrize("count", [1, 5])
def test_parameters_after_updates_equal_the_recorded_ones(recording, ours, updates, count):
    expected = recording.params(f"param_after{count}", ours["params"])
    assert_close(updates[count - 1]["params"], expected)
