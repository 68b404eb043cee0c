"""Parts of the estimate of large photographs, without a network."""

import numpy as np

from unips_jax.estimation.streaming import _masked_pixels
from unips_jax.models.views import resize_weights


def test_masked_pixels_come_in_pieces_from_strips_of_wide_masks():
    """A strip of this mask is one row: what is left of it goes into the next piece."""
    mask = np.zeros((5, 2**18), bool)
    mask[1:, [3, 7, 100_000]] = mask[4, 9] = True
    pieces = list(_masked_pixels(mask, 4))
    assert [len(y) for y, _ in pieces] == [4, 4, 4, 1]
    found = np.concatenate([np.stack(piece) for piece in pieces], axis=1)
    np.testing.assert_array_equal(found, np.nonzero(mask))
    assert not list(_masked_pixels(np.zeros((5, 7), bool), 4))


def test_antialiasing_changes_nothing_where_cells_are_smaller_than_pixels():
    start, side = np.int32(2), np.int32(5)
    plain, widened = (resize_weights(start, side, 16, 9, how) for how in (False, True))
    np.testing.assert_array_equal(widened, plain)
    np.testing.assert_allclose(plain.sum(axis=1), 1, atol=1e-6)
    fewer = resize_weights(start, side, 2, 9, True)
    assert ((fewer > 0).sum(axis=1) > 2).all()  # more than the two nearest
