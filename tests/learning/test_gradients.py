"""Gradients summed in chunks of time: the same sum, bounded memory, nothing after the end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_reinforce.learning.policy import MLP
from mjx_reinforce.learning.samples import accumulate_gradient, in_groups
from mjx_reinforce.learning.value import value_network


def loss(params, chunk):
    x, factor, mask = chunk
    total = jnp.sum(jnp.where(mask, jnp.tanh(params["w"] * factor[..., 0] * x), 0.0))
    return total, {"steps": jnp.sum(mask), "x": jnp.sum(jnp.where(mask, x, 0.0))}


PARAMS = {"w": jnp.array(0.7)}


@pytest.mark.parametrize("longest", [0, 6, 254, 256])
def test_the_sum_is_over_every_step_and_chunks_after_the_end_are_skipped(longest):
    """256 steps are two chunks of 128; in a chunk that is visited, NaN would reach the gradient."""
    lengths = np.array([longest, longest // 2])
    mask = np.arange(256)[:, None] < lengths
    x = np.random.default_rng(0).normal(size=(256, 2))
    unvisited = np.arange(256) >= (0 if longest == 0 else 128 if longest <= 128 else 256)
    poisoned = np.where(unvisited[:, None], np.nan, x)
    data = tuple(map(jnp.asarray, (poisoned, np.ones((256, 2, 1)), mask)))
    total, grads, sums = accumulate_gradient(loss, PARAMS, data)
    slope = np.sum((x / np.cosh(0.7 * x) ** 2)[mask])
    assert float(total) == pytest.approx(np.sum(np.tanh(0.7 * x)[mask]), rel=1e-5, abs=1e-6)
    assert float(grads["w"]) == pytest.approx(slope, rel=1e-5, abs=1e-6)
    assert int(sums["steps"]) == lengths.sum()
    assert float(sums["x"]) == pytest.approx(np.sum(x[mask]), rel=1e-5, abs=1e-5)


def test_integers_are_summed_as_integers():
    data = jnp.ones((4, 2)), jnp.ones((4, 2, 1)), jnp.ones((4, 2), bool)
    _, _, sums = accumulate_gradient(loss, PARAMS, data)
    assert jnp.issubdtype(sums["steps"].dtype, jnp.integer)


def chunk_length(horizon, num_episodes):
    """Returns how many steps the loss sees at once; nothing is computed."""
    seen = []

    def watched(params, chunk):
        seen.append(chunk[-1].shape)
        return loss(params, chunk)

    data = (
        jax.ShapeDtypeStruct((horizon, num_episodes), jnp.float32),
        jax.ShapeDtypeStruct((horizon, num_episodes, 1), jnp.float32),
        jax.ShapeDtypeStruct((horizon, num_episodes), jnp.bool),
    )
    jax.eval_shape(lambda *data: accumulate_gradient(watched, PARAMS, data), *data)
    lengths = {shape[0] for shape in seen}
    assert {shape[1:] for shape in seen} == {(num_episodes,)}
    assert len(lengths) == 1
    return lengths.pop()


@pytest.mark.parametrize(
    ("horizon", "num_episodes", "expected"),
    [
        (100, 4, 100),
        (256, 4, 128),  # at most 128 steps
        (258, 4, 86),  # and not 129
        (1000, 4, 125),  # the largest divisor below
        (12, 2**18 // 6, 6),  # at most 2**18 samples
        (12, 2**18 // 6 + 1, 4),
        (12, 2**19, 1),  # more episodes than samples: a step at a time
    ],
)
def test_a_chunk_is_as_long_as_memory_allows(monkeypatch, horizon, num_episodes, expected):
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    assert chunk_length(horizon, num_episodes) == expected


def test_a_gpu_holds_four_times_as_many_samples(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert chunk_length(12, 2**20 // 6) == 6
    assert chunk_length(12, 2**20 // 6 + 1) == 4


def test_seeds_side_by_side_stop_each_at_its_own_end():
    """Beside a seed of longer episodes the loop goes on: what it adds then is nothing."""
    masks = np.arange(256)[:, None] < np.array([[3], [200]])[:, None, :]
    x = np.random.default_rng(0).normal(size=(2, 256, 1))
    data = tuple(map(jnp.asarray, (x, np.ones((2, 256, 1, 1)), masks)))
    together = jax.vmap(lambda *data: accumulate_gradient(loss, PARAMS, data))(*data)
    for s in range(2):
        alone = accumulate_gradient(loss, PARAMS, jax.tree.map(lambda x, s=s: x[s], data))
        jax.tree.map(
            lambda a, b, s=s: np.testing.assert_allclose(a[s], b, rtol=1e-5), together, alone
        )


@pytest.mark.parametrize("shape", [(125, 8, 3), (2048, 3), (6, 128, 3)])
def test_a_gpu_sums_gradients_in_groups_and_has_the_same_derivatives(monkeypatch, shape):
    network = MLP((8,), 2)
    params = network.init(jax.random.key(0), jnp.zeros(3))
    inputs = jax.random.normal(jax.random.key(1), shape)
    weight = jax.random.normal(jax.random.key(2), (*shape[:-1], 2))
    tangent = jax.tree.map(jnp.ones_like, params)

    def derivatives(apply):
        outputs, push = jax.linearize(lambda params: apply(params, inputs), params)
        return outputs, push(tangent), jax.linear_transpose(push, params)(weight)[0]

    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    grouped = derivatives(in_groups(network.apply))
    for expected, value in zip(
        jax.tree.leaves(derivatives(network.apply)), jax.tree.leaves(grouped), strict=True
    ):
        np.testing.assert_allclose(value, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("backend", "shape", "num_groups"),
    [
        ("cpu", (2048, 3), 1),
        ("gpu", (511, 3), 1),  # less than two groups of 256 samples
        ("gpu", (2048, 3), 8),
        ("gpu", (125, 256, 3), 25),  # the largest divisor of 125 that is at most 32
        ("gpu", (125, 25, 3), 5),  # at most 12, for 3,125 samples
        ("gpu", (127, 256, 3), 1),  # a prime number of steps
    ],
)
def test_a_group_has_enough_samples(monkeypatch, backend, shape, num_groups):
    """Each group has its own copy of the parameters, with an axis of the groups in front."""
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    seen = []

    def apply(params, inputs):
        seen.append(inputs.shape)
        return inputs @ params

    outputs = jax.eval_shape(in_groups(apply), jnp.ones((3, 2)), jnp.ones(shape))
    assert outputs.shape == (*shape[:-1], 2)
    # Episodes, the second axis, stay apart, as several devices divide them.
    assert seen == [(shape[0] // num_groups, *shape[1:])]


def test_only_the_baseline_may_be_rounded():
    def precisions(network):
        params = jax.eval_shape(network.init, jax.random.key(0), jnp.zeros(3))
        products = jax.make_jaxpr(network.apply)(params, jnp.zeros((4, 3))).eqns
        return {eqn.params["precision"] for eqn in products if "dot_general" in str(eqn.primitive)}

    exact, rounded = jax.lax.Precision.HIGHEST, jax.lax.Precision.DEFAULT
    assert precisions(MLP((8,), 2)) == {(exact, exact)}
    assert precisions(value_network((8,))) == {(rounded, rounded)}
