"""Every backend knows every operation, and a new one is a class."""

import itertools
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from mjx_reinforce.engine import scalar
from mjx_reinforce.engine.llvm.emit import LLVM, Input
from mjx_reinforce.engine.llvm.text import Text
from mjx_reinforce.engine.play import program
from mjx_reinforce.engine.play.program import machine_map
from mjx_reinforce.engine.scalar import scalarized, skippable
from mjx_reinforce.engine.scalar.graph import Graph
from mjx_reinforce.engine.scalar.nodes import OP_TRAITS, Op, conversion, is_constant
from mjx_reinforce.engine.scalar.passes import simplify
from mjx_reinforce.engine.scalar.passes.liveness import LiveLoop, accumulators
from mjx_reinforce.engine.scalar.vmap import XLA

#: Operands of which every float operation is finite.
FLOATS = np.float32([0.25, 0.5, 0.75])
BITS = np.int32([6, 3, 0])
ON_BITS = {
    *("and", "or", "xor", "not", "shift_left", "shift_right_arithmetic", "shift_right_logical"),
    *("clz", "population_count"),
}
#: What takes two operands; a selection takes three, all others one.
BINARY = {
    *("add", "sub", "mul", "div", "rem", "pow", "atan2", "nextafter", "max", "min"),
    *("and", "or", "xor", "shift_left", "shift_right_arithmetic", "shift_right_logical"),
    *("eq", "ne", "lt", "le", "gt", "ge"),
}
PARAMS = {
    "convert_element_type": {"new_dtype": np.dtype(np.int32)},
    "bitcast_convert_type": {"new_dtype": np.dtype(np.int32)},
    "reduce_precision": {"exponent_bits": 8, "mantissa_bits": 7},
    "round": {"rounding_method": lax.RoundingMethod.TO_NEAREST_EVEN},
}


def operands_of(name):
    values = BITS if name in ON_BITS else FLOATS
    operands = list(values[: 2 if name in BINARY else 1])
    if name == "select_n":
        operands = [np.True_, *values[1:]]
    if name == "acosh":
        operands = [np.float32(1.5)]
    return operands


def dtype_of(op, operands):
    if "new_dtype" in dict(op.params):
        return dict(op.params)["new_dtype"]
    return np.dtype(bool) if OP_TRAITS[op.name].is_predicate else operands[-1].dtype


def test_a_backend_with_a_table_knows_every_operation():
    for backend in (XLA, LLVM):
        assert set(backend.OPERATIONS or OP_TRAITS) == set(OP_TRAITS)


def test_a_backend_walks_loops_and_gates():
    """Of a loop that ends by what the lanes hold, and a branch that some lanes do not need."""

    def branches_and_repeats(x):
        x = lax.while_loop(lambda y: y < 3.0, lambda y: jnp.sin(y) + 2.0 * y, x)
        return lax.cond(x > 5.0, lambda y: jnp.exp(jnp.cos(y) / y), lambda y: y, x)

    written = scalar.scalarize(branches_and_repeats, jnp.ones(()), branch_cost=1)
    for backend in (
        XLA(lambda place: jnp.linspace(1.0, 2.0, 4), (4,)),
        LLVM(Text(4), lambda number: Input("%input", np.dtype(np.float32))),
    ):
        assert written.compile(backend)


def folded_and_computed(name):
    """Returns [mixes, 2] what XLA computes of constants and lanes in every order, and the fold."""
    op = Op(name, tuple(sorted(PARAMS.get(name, {}).items())))
    operands = operands_of(name)
    dtype = dtype_of(op, operands)
    folded = simplify.fold(op, operands, dtype)
    assert (folded.dtype, np.ndim(folded)) == (dtype, 0), name
    assert np.isfinite(folded), name
    _, *mixes = itertools.product([False, True], repeat=len(operands))
    steps, outputs, graph = [], [], Graph(0, 4)
    leaves = [graph.leaf(x.dtype, True, position=(0, i)) for i, x in enumerate(operands)]
    for mix in mixes:
        mixed = [leaf if lane else x for leaf, x, lane in zip(leaves, operands, mix, strict=True)]
        node = graph.apply(op, tuple(mixed), dtype)
        steps += [] if is_constant(node) or node.op is None or node in steps else [node]
        outputs.append(node)
    backend = XLA(lambda place: jnp.full(2, operands[place[1]]), (2,))
    return [np.broadcast_to(x, 2) for x in backend.compile(steps, [outputs])[0]], folded


@pytest.mark.slow
def test_constants_fold_to_what_jax_computes():
    """The same operation on constants, on lanes, and on both, in every order."""
    for name in OP_TRAITS:
        computed, folded = folded_and_computed(name)
        want = np.full((len(computed), 2), folded)
        np.testing.assert_allclose(computed, want, rtol=1e-5, err_msg=name)


def test_operations_that_commute_are_shared():
    graph = Graph(0, 4)
    for name in (n for n, traits in OP_TRAITS.items() if traits.commutes):
        x, y = (graph.leaf(operands_of(name)[0].dtype, True) for _ in range(2))
        assert graph.call(name, x, y) is graph.call(name, y, x), name


def test_equal_operations_are_equal():
    float32, int32 = np.dtype(np.float32), np.dtype(np.int32)
    assert len({conversion(float32), conversion(float32), conversion(int32)}) == 2


def test_the_graph_itself_knows_no_jax():
    """What is computed is the backend's; the graph, its algebra and its rules move scalars."""
    root, found = Path(scalar.__file__).parent, []
    for module in ("nodes", "graph", "passes", "rules"):
        where = root / module
        for path in where.glob("*.py") if where.is_dir() else [where.with_suffix(".py")]:
            text = path.read_text("utf-8")
            found += [path] * bool(re.search(r"^ *(import|from) jax\b", text, re.MULTILINE))
    assert found == []


# -------------------------------------------------------------------------------------------------
# Carries that need no copy: those the body does not read, and those that a branch adds to.

#: Entries of a matrix, more than stay in registers.
SIZE = 6
ROWS = jnp.asarray(np.random.default_rng(0).normal(size=(5, 4, SIZE)), jnp.float32)


def added_up(weights, between=lambda total, _: total):
    """Adds to a matrix for each weight that is positive; ``between`` changes it in each round."""

    def add(total, row):
        weight, vector = row

        def compute():
            grown = total
            for k in range(1, 4):
                grown = grown + jnp.sin(weight * k) * jnp.outer(vector, vector)
            return grown

        return between(skippable(weight > 0, compute, total), weight), None

    # A skippable sum: sin(0) is 0.
    return lax.scan(add, jnp.ones((SIZE, SIZE)), (jnp.maximum(weights, 0), ROWS[0]))[0]


def twice(weights):
    """What the first loop adds up goes on in the second, which alone reads it."""
    first = added_up(weights)

    def add(total, row):
        weight, vector = row
        compute = lambda: total + jnp.sin(weight * jnp.outer(vector, vector))  # noqa: E731
        return skippable(weight > 0, compute, total), None

    return lax.scan(add, first, (jnp.maximum(weights, 0), ROWS[1]))[0]


def start_read_again(weights):
    """The start of the second loop is read after it too: it must not be changed in place."""
    first = added_up(weights)
    second = lax.scan(
        lambda total, w: (skippable(w > 0, lambda: total + jnp.sin(w * first), total), None),
        first,
        jnp.maximum(weights, 0),
    )[0]
    return second - first


def begun_again(weights):
    """The second loop starts from the first one's sums again in each round of an outer loop."""
    first = added_up(weights)

    def turn(carry, _):
        def add(total, row):
            weight, vector = row
            compute = lambda: total + jnp.sin(weight * (jnp.outer(vector, vector) + carry[0, 0]))  # noqa: E731
            return skippable(weight > 0, compute, total), None

        rows = jnp.maximum(weights, 0), ROWS[2]
        return 0.1 * carry + lax.scan(add, first, rows)[0], None

    return lax.scan(turn, jnp.zeros((SIZE, SIZE)), None, length=4)[0]


def never_read(weights):
    """The angle goes on from round to round; its cosine and the last weight are read afterwards."""

    def turn(carry, weight):
        angle, _, _, count = carry
        inner = lax.scan(lambda c, x: (c + x, c * x), angle, weights)[1]
        return (angle + weight, jnp.cos(angle), inner, count + 1), None

    start = weights[0], jnp.float32(7), jnp.zeros(4), jnp.int32(0)
    return lax.scan(turn, start, weights)[0]


def ends_early(weights):
    """A loop that may not run at all: what its body does not read has its start then."""
    return lax.while_loop(
        lambda carry: carry[0] > 1, lambda carry: (carry[0] * 0.5, carry[0]), (weights[0], 9.0)
    )


def loops_of(function):
    """Loops in the order of their ends, from the innermost on."""
    example = jnp.ones(4)
    written = scalarized.build(*scalarized.trace(function, example), 100, program.SCANS)

    def within(body):
        for step in body:
            if hasattr(step, "body"):
                yield from within(step.body)
            if isinstance(step, LiveLoop):
                yield step

    return list(within(written.schedule))


FUNCTIONS = [added_up, twice, start_read_again, begun_again, never_read, ends_early]


@pytest.mark.slow
@pytest.mark.parametrize("few", [True, False], ids=["in registers", "in place"])
@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.cpu
def test_machine_code_gives_the_results_of_vmap(function, few, monkeypatch):
    """Of lanes that need all sums, some and none."""
    monkeypatch.setattr(LLVM, "MANY_CARRIES", 1_000 if few else 1)
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(37, 4)), jnp.float32)
    weights = weights.at[0].set(-1).at[1].set(1)
    # Machine code is kept by the function that it is of: each of the two has its own.
    own = (lambda x: function(x + 0.0)) if few else (lambda x: function(x - 0.0))
    got = jax.jit(machine_map(own, weights[0]))(weights)
    want = jax.vmap(function)(weights)
    for x, exact in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(x, exact, rtol=2e-5, atol=2e-5)


@pytest.mark.cpu
def test_sums_of_a_branch_change_in_place():
    (loop,) = loops_of(added_up)
    changed = {id(carry.leaf) for carry in accumulators(loop).values()}
    assert changed == {id(carry.leaf) for carry in loop.carries}
    assert len(changed) == SIZE**2


@pytest.mark.parametrize(
    "between",
    [
        lambda total, weight: total * 2,
        lambda total, weight: total.at[0, 0].add(weight),
        lambda total, weight: total.T[::-1],
    ],
    ids=["the sum is read", "one is read", "they change places"],
)
@pytest.mark.cpu
def test_what_is_read_elsewhere_does_not(between):
    (loop,) = loops_of(lambda weights: added_up(weights, between))
    changed = {id(carry.leaf) for carry in accumulators(loop).values()}
    for carry in loop.carries:
        others = [id(other.next) for other in loop.carries if other is not carry]
        assert id(carry.leaf) not in changed or id(carry.leaf) not in others
    assert len(changed) < len(loop.carries)
