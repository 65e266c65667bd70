"""Direct solutions of symmetric systems."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse as sparse

from shared.compute.sparse_solve import factorised, solved_by_factors_of_another
from shared.compute.threads import share_out


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


@pytest.mark.parametrize("unlike", [1.0, 1e9])
def test_factors_of_another_matrix_give_the_same_solution(unlike):
    """By steps where the diagonals differ several times over, by factors of its own where nothing is alike."""
    rng, count = np.random.default_rng(3), 400
    chain = sparse.diags([-1.0, 2.1, -1.0], [-1, 0, 1], shape=(count, count))
    matrix = chain + sparse.diags(unlike * rng.uniform(0.0, 5.0, count))
    right = rng.normal(size=(count, 3)) * [1.0, 1e-6, 0.0]
    found = solved_by_factors_of_another(matrix, right, factorised(chain + sparse.identity(count)))
    assert np.allclose(found, np.linalg.solve(matrix.toarray(), right), rtol=1e-6, atol=1e-7 / unlike)
    assert not found[:, 2].any()


def test_threads_share_factors_without_asking_for_the_triangles():
    """SuperLU makes L and U when first asked, which two threads may not do at once."""
    count = 400
    chain = sparse.diags([-np.ones(count - 1), 2.5 * np.ones(count), -np.ones(count - 1)], [-1, 0, 1])
    right = np.random.default_rng(0).normal(size=(count, 8))
    whole = factorised(chain.astype(np.float32))
    factors = replace(whole, superlu=SimpleNamespace(solve=whole.superlu.solve))
    found = share_out(8, lambda k: solved_by_factors_of_another(chain, right[:, [k]], factors))
    np.testing.assert_allclose(chain @ np.concatenate(found, axis=1), right, atol=1e-6)
