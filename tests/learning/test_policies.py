"""Policies: their shapes, initial weights and trunks, and rebuilding them from settings."""

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_reinforce import Box, mlp_policy, normal
from mjx_reinforce.export import policy_files as checkpoint
from mjx_reinforce.learning.distributions import normal_softplus

SPACE = Box(np.array([-1.0, -2.0]), np.array([1.0, 2.0]))


@pytest.mark.slow
@pytest.mark.parametrize("hidden_sizes", [(), (5, 3, 4)])
@pytest.mark.parametrize("initializer", ["orthogonal", "torch"])
def test_initial_weights_and_biases(hidden_sizes, initializer):
    """With "torch" all uniform within 1 / sqrt(fan-in); with "orthogonal" the biases are zero."""
    policy = mlp_policy(400, normal(SPACE), hidden_sizes, initializer=initializer)
    params = policy.init(jax.random.key(0))
    assert policy.apply(params, jnp.zeros((6, 5, 400))).shape == (6, 5, 4)
    layers = params["network"]["params"]
    assert len(layers) == len(hidden_sizes) + 1
    for layer in layers.values():
        bound = layer["kernel"].shape[0] ** -0.5
        if initializer == "torch":
            assert np.all(np.abs(layer["kernel"]) <= bound)
            assert np.all(np.abs(layer["bias"]) <= bound)
            assert np.any(layer["bias"] != 0)
        else:
            assert np.all(layer["bias"] == 0)
    if initializer == "torch":
        first = np.ravel(layers["Dense_0"]["kernel"])
        assert np.std(first) == pytest.approx(400**-0.5 / np.sqrt(3), rel=0.05)


@pytest.mark.parametrize("hidden_sizes", [(), (5, 3, 4)])
def test_a_fresh_policy_does_nearly_the_same_in_all_states(hidden_sizes):
    """Its last layer is 0.01 times an orthogonal matrix, so it shrinks its input 100-fold."""
    policy = mlp_policy(6, normal_softplus(SPACE), hidden_sizes)
    params = policy.init(jax.random.key(0))
    last = params["network"]["params"][f"Dense_{len(hidden_sizes)}"]["kernel"]
    gains = np.linalg.svd(np.asarray(last), compute_uv=False)
    np.testing.assert_allclose(gains, 0.01, rtol=1e-5)
    # The input's entries are between -1 and 1: a tanh unit's value, or here the observation's.
    outputs = policy.apply(params, jax.random.uniform(jax.random.key(1), (100, 6), float, -1, 1))
    length = np.sqrt((hidden_sizes or (6,))[-1])
    assert np.all(np.abs(outputs) <= 0.01 * length)
    assert np.all(np.std(outputs, axis=0) > 0)


def test_policies_are_rebuilt_from_settings():
    old = {
        "policy": "normal",
        "hidden_sizes": [4],
        "initial_std": 0.3,
        "observation_size": 3,
        "action_low": [-1.0, -2.0],
        "action_high": [1.0, 2.0],
    }
    expected = mlp_policy(3, normal(SPACE, initial_std=0.3), (4,)).init(jax.random.key(0))
    params = checkpoint.build_policy(old).init(jax.random.key(0))
    jax.tree.map(np.testing.assert_array_equal, params, expected)
    settings = old | {
        "policy": "normal-sigmoid",
        "initializer": "torch",
        "rescale": False,
    }
    policy = checkpoint.build_policy(settings)
    params = policy.init(jax.random.key(0))
    outputs = policy.apply(params, jnp.ones(3))
    np.testing.assert_array_equal(policy.distribution.mode(outputs), outputs[:2])
    discrete = {k: v for k, v in old.items() if "action" not in k}
    policy = checkpoint.build_policy(discrete | {"policy": "categorical", "num_actions": 5})
    assert policy.distribution.num_outputs == 5


def test_nonsense_is_refused():
    with pytest.raises(ValueError, match="unknown initializer 'xavier'"):
        mlp_policy(3, normal(SPACE), initializer="xavier")
    with pytest.raises(ValueError, match="at least one unit"):
        mlp_policy(1, normal(SPACE), (32, 0))
