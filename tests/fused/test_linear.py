"""Rules for small linear algebra, on constants, against NumPy."""

import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from mapped import assert_folds, count, folded

RNG = np.random.default_rng(0)
A = RNG.normal(size=(2, 3, 3)).astype(np.float32)
B = RNG.normal(size=(2, 3, 4)).astype(np.float32)
SQUARE = A @ A.swapaxes(1, 2) + 3 * np.eye(3, dtype=np.float32)


def test_products_of_matrices():
    assert_folds(jnp.matmul, A, B, rtol=1e-5)
    assert_folds(lambda a, b: jnp.einsum("bij,bkj->ik", a, b), A, A, rtol=1e-5)
    assert_folds(lambda a, b: jnp.einsum("bij,bjk->kbi", a, b), A, B, rtol=1e-5)
    assert_folds(jnp.dot, A[0, 0], A[0, 1], rtol=1e-5)


def test_a_product_is_of_the_dtype_that_was_asked_for():
    whole = np.arange(3, dtype=np.int8)
    assert_folds(lambda x: lax.dot(x, x, preferred_element_type=jnp.int32), 50 * whole)


def test_a_product_of_n_m_k_is_so_many_operations():
    assert count(jnp.matmul, jnp.ones((2, 3)), jnp.ones((3, 4))) == 2 * 4 * (3 + 2)


def test_the_factor_of_cholesky():
    (factor,) = folded(lambda x: lax.linalg.cholesky(x, symmetrize_input=False), SQUARE)
    np.testing.assert_allclose(factor, np.linalg.cholesky(SQUARE), rtol=1e-5)
    assert not np.triu(factor, 1).any()


def test_what_is_not_positive_definite_is_nan_from_there_on():
    matrix = np.array([[4, 2, 0], [2, 1, 0], [0, 0, -1]], np.float32)
    (factor,) = folded(lambda x: lax.linalg.cholesky(x, symmetrize_input=False), matrix)
    assert factor[0].tolist() == [2, 0, 0]
    assert np.isnan(factor[2, 2])


@pytest.mark.parametrize("unit", [False, True])
@pytest.mark.parametrize("transpose", [False, True])
@pytest.mark.parametrize("lower", [False, True])
@pytest.mark.parametrize("left", [False, True])
def test_triangular_systems(left, lower, transpose, unit):
    triangle = (np.tril if lower else np.triu)(A) + 2 * np.eye(3, dtype=np.float32)
    right = B if left else B.swapaxes(1, 2)

    def solve(a, b):
        return lax.linalg.triangular_solve(
            a, b, left_side=left, lower=lower, transpose_a=transpose, unit_diagonal=unit
        )

    (x,) = folded(solve, triangle, right)
    if unit:
        triangle = triangle * (1 - np.eye(3)) + np.eye(3)
    matrix = triangle.swapaxes(1, 2) if transpose else triangle
    np.testing.assert_allclose(matrix @ x if left else x @ matrix, right, rtol=1e-4, atol=1e-5)
