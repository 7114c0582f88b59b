"""Tables in blocks: the same as whole tables, whatever their length and the rows wanted."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvm.physics.blocks import by_blocks, continued, roomy

RNG = np.random.default_rng(5)


@pytest.mark.parametrize("n", [1, 3, 64, 100, 2048, 2500])
@pytest.mark.parametrize("share", [None, 0.0, 0.4, 1.0])
def test_blocks_give_what_the_whole_table_gives(n, share):
    table = RNG.normal(size=(n, 3)), RNG.normal(size=n), 2.0
    only = None if share is None else np.flatnonzero(RNG.random(n) < share)

    def product(rows, factor):
        matrix, vector, scale = rows
        return scale * factor * matrix * vector[:, None], jnp.sum(matrix, axis=1)

    expected = [np.array(own) for own in product(table, 3.0)]
    if only is not None:
        for own in expected:
            own[np.setdiff1d(np.arange(n), only)] = 0.0
    for got, own in zip(by_blocks(product, table, 3.0, only=only), expected, strict=True):
        np.testing.assert_allclose(got, own, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("n", [2, 5, 40, 63, 64, 65, 100, 1000])
def test_spare_values_go_on_as_numpy_pads(n):
    values = RNG.normal(size=(3, n))
    size = max(64, 1 << (n - 1).bit_length())
    widths = [(0, 0), (0, size - n)]
    odd = np.pad(values, widths, mode="reflect", reflect_type="odd")
    np.testing.assert_array_equal(continued(values), odd)
    np.testing.assert_array_equal(roomy(values, axis=1), np.pad(values, widths, mode="edge"))
