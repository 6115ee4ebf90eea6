"""Groups of equal elements, and functions of rows chunk by chunk."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents.fast import chunks, grouping

ROWS = 37
WIDTH = 5


@pytest.mark.parametrize("bits", [None, 16, 0])
def test_groups_hold_equal_rows_and_all_of_them_unless_hashes_collide(bits, monkeypatch):
    rows = np.random.default_rng(0).integers(0, 6, (200, 2)).astype(np.int32)
    _, expected = np.unique(rows, axis=0, return_inverse=True)
    if bits is None:
        groups = grouping.group(*jnp.asarray(rows.T))
        np.testing.assert_array_equal(groups.group_id, expected)
    else:
        monkeypatch.setattr(grouping, "GROUPING_BITS", bits)
        groups = grouping.group_rows(jnp.asarray(rows))
    representative = np.asarray(groups.representative)[np.asarray(groups.group_id)]
    np.testing.assert_array_equal(rows[representative], rows)
    assert groups.total == np.max(groups.group_id) + 1
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


def total(fn: Any, chunk: int, problem: Any, params: Any, count: Any) -> jax.Array:
    """Sums the weighted features of the first `count` rows, by `plain` if there is no `fn`."""
    _, rows, cotangent = problem
    if fn is None:
        features = plain(params, rows)
    else:
        features: Any = chunks.map_rows(fn, chunk, params, rows, count)
    return jnp.sum(jnp.where((jnp.arange(ROWS) < count)[:, None], features, 0) * cotangent)


def assert_close(tree: Any, other: Any) -> None:
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), tree, other)


@pytest.mark.parametrize("fn", [forgetful, remembering])
@pytest.mark.parametrize("chunk", [1, 8, 37, 64])
def test_chunked_rows_have_the_value_and_gradient_of_whole_ones(problem, fn, chunk, monkeypatch):
    monkeypatch.setattr(chunks, "REMEMBERED_BYTES", 16 * 4 * WIDTH)
    got, want = (
        jax.jit(jax.value_and_grad(partial(total, function, chunk, problem)))
        for function in (fn, None)
    )
    for count in (0, 1, 8, 9, ROWS):
        assert_close(got(problem[0], count), want(problem[0], count))


def test_a_function_without_a_derivative_at_zero_has_its_gradient(problem):
    """The padding of the last chunk must not make it NaN."""
    params, rows, cotangent = problem

    def unit(params: Any, rows: Any, _: Any) -> tuple[jax.Array, None]:
        x = rows @ params["w"]
        return x / jnp.linalg.norm(x, axis=-1, keepdims=True), None

    expected = jax.grad(lambda params: jnp.sum(unit(params, rows, None)[0] * cotangent))(params)
    assert_close(jax.grad(partial(total, unit, 8, problem))(params, ROWS), expected)


def test_map_rows_under_vmap_with_different_counts(problem):
    many = jax.tree.map(lambda leaf: jnp.stack([leaf, 2 * leaf, -leaf]), problem[0])
    counts = jnp.array([0, 5, ROWS])
    got, want = (
        jax.jit(jax.vmap(jax.grad(partial(total, fn, 8, problem)))) for fn in (remembering, None)
    )
    assert_close(got(many, counts), want(many, counts))


def test_shared_maximum_is_unbatched():
    doubled = jax.vmap(jax.vmap(lambda x: x + chunks.shared_maximum(x)))
    np.testing.assert_array_equal(doubled(jnp.array([[1, 2], [3, 4]])), [[5, 6], [7, 8]])
