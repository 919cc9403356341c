"""Algebra on scalars: what need not be computed, and what it deviates by."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from mapped import assert_all_same, batch_of, count

from mjx_reinforce.engine import scalar
from mjx_reinforce.engine.scalar.passes import simplify

NUMBERS = jnp.array([jnp.nan, jnp.inf, -jnp.inf, -0.0, 0.0, 1.0])


#: The exceptions that the docstring of `fused` lists, and what each makes of `NUMBERS`.
EXCEPTIONS = {
    "x * 0": (lambda x: x * 0.0, [0, 0, 0, 0, 0, 0]),
    "0 / x": (lambda x: 0.0 / x, [0, 0, 0, 0, 0, 0]),
    "x - x": (lambda x: x - x, [0, 0, 0, 0, 0, 0]),
    "x times a bool": (lambda x: x * (x == 1), [0, 0, 0, 0, 0, 1]),
    "x + 0": (lambda x: 1 / (x + 0.0), [np.nan, 0, -0.0, -np.inf, np.inf, 1]),
    "0 - x": (lambda x: 1 / (0.0 - x), [np.nan, -0.0, 0, np.inf, -np.inf, -1]),
    "-(x - y)": (lambda x: 1 / -(x - 1.0), [np.nan, -0.0, 0, 1, 1, np.inf]),
}


def test_exceptions_of_floating_point_are_listed():
    made = scalar.vmap(lambda x: {name: fn(x) for name, (fn, _) in EXCEPTIONS.items()})
    for name, result in jax.jit(made)(NUMBERS).items():
        np.testing.assert_array_equal(result, np.float32(EXCEPTIONS[name][1]), err_msg=name)
        assert name in (scalar.__doc__ or "")


def test_the_algebra_quotes_the_list_of_exceptions():
    listed = (scalar.__doc__ or "").partition("are constants:\n\n")[2].partition("- Sums")[0]
    assert listed.count("\n- ") == 3
    assert listed in (simplify.__doc__ or "")


def test_constants_fold_and_common_subexpressions_are_shared():
    def fn(x):
        matrix = jnp.array([[0.0, 1.0], [2.0, 0.0]])
        return matrix @ x + jnp.sin(jnp.ones(2)) * 0 + jnp.sin(x[0]) + jnp.sin(x[0])

    # one product by 2, one sine, and in each of two elements the two sums with the sine
    assert count(fn, jnp.ones(2)) == 6


def where(x, on, off):
    return jnp.where(x > 0, on, off)


TWO = "gt gt select_n select_n mul"
#: function of x and y -> the operations that are left of it.
SIMPLER = {
    "x + 0": (lambda x, y: x + 0, ""), "x * 1": (lambda x, y: x * 1, ""),
    "x * -1": (lambda x, y: x * -1, "neg"), "x / 1": (lambda x, y: x / 1, ""),
    "x / 4 is exact": (lambda x, y: x / 4, "mul"), "x / 3 is not": (lambda x, y: x / 3, "div"),
    "x / x may be NaN": (lambda x, y: x / x, "div"),
    "x == x tells NaN": (lambda x, y: x == x, "eq"), "x + -y": (lambda x, y: x + -y, "sub"),
    "x - -y": (lambda x, y: x - -y, "add"), "-x * -y": (lambda x, y: -x * -y, "mul"),
    "-x * 2": (lambda x, y: -x * 2, "mul"), "-(x - y)": (lambda x, y: -(x - y), "sub"),
    "-(-x)": (lambda x, y: jnp.negative(-x), ""), "|-x|": (lambda x, y: jnp.abs(-x), "abs"),
    "max(x, x)": (lambda x, y: jnp.maximum(x, x), ""),
    "max(x, -inf)": (lambda x, y: jnp.maximum(x, -jnp.inf), ""),
    "min(inf, x)": (lambda x, y: jnp.minimum(jnp.inf, x), ""),
    "max(x, inf) may be NaN": (lambda x, y: jnp.maximum(x, jnp.inf), "max"),
    "x ** 3.0": (lambda x, y: lax.pow(x, 3.0), "mul mul"),
    "x ** -2.0": (lambda x, y: lax.pow(x, -2.0), "mul div"),
    "x ** 9.0 is long": (lambda x, y: lax.pow(x, 9.0), "pow"),
    "x ** 0.5": (lambda x, y: lax.pow(x, 0.5), "pow"),
    "x ** inf": (lambda x, y: lax.pow(x, jnp.inf), "pow"),
    "x ** y": (lambda x, y: lax.pow(x, y), "pow"),
    "and with itself": (lambda x, y: (x > y) & (x > y), "gt"),
    "and with True": (lambda x, y: (x > y) & True, "gt"),
    "and with False": (lambda x, y: (x > y) & False, ""),
    "or with True": (lambda x, y: (x > y) | True, ""), "not not": (lambda x, y: ~~(x > y), "gt"),
    "the same cases": (lambda x, y: where(x, y, y), ""),
    "not which": (lambda x, y: jnp.where(~(x > 0), x, y), "gt select_n"),
    "true or false": (lambda x, y: where(x, True, False), "gt"),
    "false or true": (lambda x, y: where(x, False, True), "gt not"),
    "true or other": (lambda x, y: where(x, True, y > 0), "gt gt or"),
    "other or false": (lambda x, y: where(x, y > 0, False), "gt gt and"),
    "false or other": (lambda x, y: where(x, False, y > 0), "gt gt not and"),
    "other or true": (lambda x, y: where(x, y > 0, True), "gt gt not or"),
    "on twice": (lambda x, y: where(x, where(x, 1.0, y), x), "gt select_n"),
    "off twice": (lambda x, y: where(x, x, where(x, y, 1.0)), "gt select_n"),
    "times a bool": (lambda x, y: (x > 0) * y, "gt select_n"),
    "times not a bool": (lambda x, y: (1.0 - (x > 0)) * y, "gt select_n"),
    "a bool as a number": (lambda x, y: (x > 0).astype(jnp.float32), "gt select_n"),
    "of constants": (lambda x, y: jnp.sin(where(x, 1.0, 2.0)) * 3, "gt select_n"),
    "of different choices": (lambda x, y: where(x, 1.0, 2.0) * where(y, 3.0, 4.0), TWO),
}  # fmt: skip


def test_what_is_left():
    functions = {name: fn for name, (fn, _) in SIMPLER.items()}
    assert_all_same(functions, batch_of(), batch_of(seed=1), rtol=1e-5)
    left = {
        name: sorted(scalar.scalarize(fn, 1.0, 1.0).operations.elements())
        for name, fn in functions.items()
    }
    assert left == {name: sorted(expected.split()) for name, (_, expected) in SIMPLER.items()}


def test_the_wrong_case_of_a_constant_choice_is_not_computed():
    function = lambda x: lax.select_n(jnp.int32(1), jnp.sin(x), jnp.cos(x), x)  # noqa: E731
    assert scalar.scalarize(function, 1.0).operations == {"cos": 1}
