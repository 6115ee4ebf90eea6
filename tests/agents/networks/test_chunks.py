"""Groups of equal elements, and functions of rows chunk by chunk."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents.networks import chunks, grouping

ROWS, WIDTH = 37, 5


@pytest.mark.parametrize("bits", [None, 16, 0])
def test_groups_hold_equal_rows_and_all_of_them_unless_hashes_collide(bits, monkeypatch):
    rows = np.random.default_rng(0).integers(0, 6, (200, 2)).astype(np.int32)
    _, expected = np.unique(rows, axis=0, return_inverse=True)
    if bits is None:
        groups = grouping.group(*jnp.asarray(rows.T))
        np.testing.assert_array_equal(groups.number, expected)
    else:
        monkeypatch.setattr(grouping, "GROUPING_BITS", bits)
        groups = grouping.group_rows(jnp.asarray(rows))
    representative = np.asarray(groups.representative)[np.asarray(groups.number)]
    np.testing.assert_array_equal(rows[representative], rows)
    assert groups.total == np.max(groups.number) + 1
    assert (groups.total > expected.max() + 1) == (bits == 0)


def plain(params: dict[str, jax.Array], rows: jax.Array) -> jax.Array:
    return jnp.tanh(rows @ params["w"] + params["b"].reshape(1, -1))


def forgetful(params: dict[str, jax.Array], rows: jax.Array, _: None) -> tuple[jax.Array, None]:
    return plain(params, rows), None


def remembering(
    params: dict[str, jax.Array], rows: jax.Array, remembered: dict[str, jax.Array] | None
) -> tuple[jax.Array, dict[str, jax.Array]]:
    product = rows @ params["w"]
    if remembered is not None:
        product = chunks.recall(product, remembered["product"])
    return jnp.tanh(product + params["b"].reshape(1, -1)), {"product": product}


@pytest.fixture(scope="module")
def problem() -> tuple[dict[str, jax.Array], jax.Array, jax.Array]:
    keys = jax.random.split(jax.random.key(0), 4)
    params = {
        "w": jax.random.normal(keys[0], (3, WIDTH)),
        "b": jax.random.normal(keys[1], (WIDTH,)),
    }
    return params, jax.random.normal(keys[2], (ROWS, 3)), jax.random.normal(keys[3], (ROWS, WIDTH))


@pytest.mark.parametrize("fn", [forgetful, remembering])
@pytest.mark.parametrize("chunk", [1, 8, 37, 64])
def test_map_rows_and_its_gradient(problem, fn, chunk, monkeypatch):
    monkeypatch.setattr(chunks, "REMEMBERED_BYTES", 16 * 4 * WIDTH)
    params, rows, cotangent = problem

    def ours(params, count):
        features: Any = chunks.map_rows(fn, chunk, params, rows, count)
        return jnp.sum(jnp.where((jnp.arange(ROWS) < count)[:, None], features, 0) * cotangent)

    def reference(params, count):
        return jnp.sum(plain(params, rows[:count]) * cotangent[:count])

    compiled = jax.jit(jax.value_and_grad(ours))
    for count in (0, 1, 8, 9, ROWS):
        got, want = compiled(params, count), jax.value_and_grad(reference)(params, count)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), got, want)


def test_map_rows_under_vmap_with_different_counts(problem):
    params, rows, cotangent = problem
    many = jax.tree.map(lambda leaf: jnp.stack([leaf, 2 * leaf, -leaf]), params)
    counts = jnp.array([0, 5, ROWS])

    def gradient(params, count):
        def total(params):
            features: Any = chunks.map_rows(remembering, 8, params, rows, count)
            return jnp.sum(features * cotangent * (jnp.arange(ROWS) < count)[:, None])

        return jax.grad(total)(params)

    together = jax.jit(jax.vmap(gradient))(many, counts)
    alone = [
        gradient(jax.tree.map(lambda leaf, i=index: leaf[i], many), counts[index])
        for index in range(3)
    ]
    alone = jax.tree.map(lambda *leaves: jnp.stack(leaves), *alone)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), together, alone
    )


def test_shared_maximum_is_unbatched():
    doubled = jax.vmap(jax.vmap(lambda x: x + chunks.shared_maximum(x)))
    np.testing.assert_array_equal(doubled(jnp.array([[1, 2], [3, 4]])), [[5, 6], [7, 8]])
