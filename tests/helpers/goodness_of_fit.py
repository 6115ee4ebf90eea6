"""Pearson's chi-square test against probabilities that are known exactly."""

import numpy as np
from scipy.special import chdtrc

# One false alarm in 30,000 tests of a correct sampler; seeds are fixed, so it stays away.
SMALLEST_CHANCE = 1 / 30_000
SMALLEST_EXPECTATION = 5.0


def assert_fits(counts: np.ndarray, chances: np.ndarray) -> None:
    """Refuses counts that samples of distribution `chances` would hardly give.

    Nothing may fall where the chance is 0. Rare outcomes are tested together, at five
    expected counts or more.
    """
    counts = np.ravel(counts)
    chances = np.ravel(chances)
    assert counts.shape == chances.shape
    np.testing.assert_allclose(chances.sum(), 1, rtol=1e-9)
    impossible = counts[chances == 0]
    assert not impossible.any(), f"{impossible.sum()} samples lie outside the support"
    expected = chances * counts.sum()
    rare = expected < SMALLEST_EXPECTATION
    observed = np.append(counts[~rare], counts[rare].sum())
    expected = np.append(expected[~rare], expected[rare].sum())
    if expected[-1] < SMALLEST_EXPECTATION:
        observed = observed[:-1]
        expected = expected[:-1]
    parts = (observed - expected) ** 2 / expected
    degrees = max(len(expected) - 1, 1)
    worst = np.argmax(parts)
    assert chdtrc(degrees, parts.sum()) > SMALLEST_CHANCE, (
        f"chi-square {parts.sum():.1f} with {len(expected)} cells; the worst has "
        f"{observed[worst]:.0f} samples, expected {expected[worst]:.1f}"
    )
