"""Rules for small linear algebra, on lanes and on constants."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from mapped import assert_all_same, batch_of, count, folded

CASES = {
    "matrices": lambda a, b: jnp.matmul(a, b),
    "transposed": lambda a, b: jnp.einsum("bij,bkj->ik", a, a),
    "batch behind": lambda a, b: jnp.einsum("bij,bjk->kbi", a, b),
    "mapped": lambda a, b: jax.vmap(jnp.dot)(a[0], a[1]),
    "vectors": lambda a, b: jnp.dot(a[0, 0], a[0, 1]),
    "a dtype that was asked for": lambda a, b: lax.dot(
        (60 * a[0]).astype(jnp.int8), (60 * a[1]).astype(jnp.int8), preferred_element_type=jnp.int32
    ),
    "Cholesky": lambda a, b: lax.linalg.cholesky(
        a @ a.swapaxes(1, 2) + 3 * jnp.eye(3), symmetrize_input=False
    ),
    "symmetrized": lambda a, b: jnp.linalg.cholesky(a[0].T + a[0] + 9 * jnp.eye(3)),
}


def solver(left_side, lower, transpose_a, unit_diagonal):
    """Solves triangular systems, whose matrix has other numbers beside the triangle."""

    def solve(a, b):
        return lax.linalg.triangular_solve(
            a + 3 * jnp.eye(3), b if left_side else b.swapaxes(1, 2), left_side=left_side,
            lower=lower, transpose_a=transpose_a, unit_diagonal=unit_diagonal,
        )  # fmt: skip

    return solve


CASES |= {
    f"left {case[0]}, lower {case[1]}, transposed {case[2]}, unit {case[3]}": solver(*case)
    for case in itertools.product([False, True], repeat=4)
}


def test_products_factors_and_triangular_systems():
    assert_all_same(CASES, batch_of(2, 3, 3)[:2], batch_of(2, 3, 4)[:2], rtol=1e-4, atol=1e-5)


def test_a_product_of_n_m_k_is_so_many_operations():
    assert count(jnp.matmul, jnp.ones((2, 3)), jnp.ones((3, 4))) == 2 * 4 * (3 + 2)


def test_what_is_not_positive_definite_is_nan_from_there_on():
    matrix = np.array([[4, 2, 0], [2, 1, 0], [0, 0, -1]], np.float32)
    (factor,) = folded(lambda x: lax.linalg.cholesky(x, symmetrize_input=False), matrix)
    assert factor[0].tolist() == [2, 0, 0]
    assert np.isnan(factor[2, 2])
