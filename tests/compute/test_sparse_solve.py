"""Direct solutions of symmetric systems."""

import numpy as np
import pytest
import scipy.sparse as sparse

from shared.compute.sparse_solve import factorised


def test_it_solves_a_membrane():
    """-u'' = 1 between ends held at 0: u = x (1 - x) / 2, exactly so for second differences."""
    count = 99
    step = 1.0 / (count + 1)
    second = sparse.diags([-1.0, 2.0, -1.0], [-1, 0, 1], shape=(count, count)) / step**2
    x = step * np.arange(1, count + 1)
    solved = factorised(second).solve(np.ones((count, 2)))
    assert np.allclose(solved, (0.5 * x * (1.0 - x))[:, None], rtol=1e-10)


def test_a_singular_matrix_is_refused():
    with pytest.raises(RuntimeError, match="singular"):
        factorised(sparse.csr_matrix((3, 3)))
