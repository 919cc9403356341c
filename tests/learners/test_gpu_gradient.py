"""The kernel of a small policy's gradient, interpreted, against ``jax.value_and_grad``."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AbstractDevice, AbstractMesh, AxisType, use_abstract_mesh

from mjx_reinforce import envs, mlp_policy, reinforce, train_step
from mjx_reinforce.devices import RUNS, Devices
from mjx_reinforce.learners.gpu import gradient, kernel
from mjx_reinforce.learners.reinforce import _loss, _surrogate
from mjx_reinforce.registry import DISTRIBUTIONS, load_choice
from mjx_reinforce.types import Box, Discrete

FAMILIES = [x for x in DISTRIBUTIONS if x != "deterministic"]
SAMPLES = 9 * 11


@pytest.fixture
def interpreted(monkeypatch):
    """Tiles are of 32 samples, a program has one or two, and products are in float32."""
    launch = functools.partial(kernel.launch, interpret=True)
    monkeypatch.setattr(kernel, "launch", launch)
    for name, number in {"TILE": 32, "TILES": 1, "PROGRAMS": 2}.items():
        monkeypatch.setattr(kernel, name, number)
    whole = lambda x: kernel._Split(x, jnp.zeros_like(x))  # noqa: E731
    monkeypatch.setattr(kernel, "_split", whole)


@pytest.fixture
def on_a_gpu(monkeypatch):
    """JAX finds a GPU of the kind that it was measured on, and any samples are enough."""
    monkeypatch.setattr(gradient, "_capability", lambda: gradient.MEASURED)
    monkeypatch.setattr(gradient, "LEAST_SAMPLES", 1)


def problem(family, hidden=(16, 32), seed=0):
    """Returns a policy, its parameters and 9 x 11 samples, no multiple of a tile."""
    box = Box(np.array([-1.0, -2.0], np.float32), np.array([1.0, 3.0], np.float32))
    space = Discrete(3) if family == "categorical" else box
    policy = mlp_policy(5, load_choice("policy", family, DISTRIBUTIONS)(space), hidden)
    keys = jax.random.split(jax.random.key(seed), 6)
    params = jax.tree.map(
        lambda x: x + 0.2 * jax.random.normal(keys[0], x.shape), policy.init(keys[1])
    )
    observation = 2.0 * jax.random.normal(keys[2], (9, 11, 5))
    outputs = policy.apply(params, observation)
    noise = policy.distribution.noise(keys[3], (9, 11))
    action = policy.distribution.sample(outputs, noise)
    weight = jax.random.normal(keys[4], (9, 11))
    mask = jax.random.uniform(keys[5], (9, 11)) < 0.7
    return policy, params, (observation, action, weight, mask)


def by_kernel(policy, cost, params, samples):
    loss = functools.partial(_loss, policy.distribution)
    return gradient.kernel_gradient(loss, params, samples, jnp.asarray(cost))


def by_xla(policy, cost, params, samples):
    differentiate = jax.value_and_grad(_surrogate(policy, cost), has_aux=True)
    (value, metrics), grads = differentiate(params, samples)
    return value, grads, metrics


def assert_equal(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert x.shape == y.shape
        # The loss is a sum of terms of both signs, of about 1 each.
        assert np.linalg.norm(x - y) <= 1e-5 * (np.linalg.norm(y) if y.ndim else SAMPLES)


@pytest.mark.usefixtures("interpreted")
@pytest.mark.parametrize("family", FAMILIES)
def test_every_distribution(family):
    policy, params, samples = problem(family)
    found = jax.jit(functools.partial(by_kernel, policy))(0.3, params, samples)
    assert_equal(found, jax.jit(functools.partial(by_xla, policy))(0.3, params, samples))


@pytest.mark.parametrize("over", [(1, 0), (0, 0), (1, 1)])
def test_products(over):
    a, b = np.random.default_rng(0).normal(size=(2, 40, 40)).astype(np.float32)
    found = kernel._product(*map(kernel._split, (a, b)), over)
    assert found.dtype == jnp.float32
    a, b = (
        x.astype(float) if over[k] == 1 - k else x.T.astype(float) for k, x in enumerate((a, b))
    )
    error = np.abs(found - a @ b) / (np.abs(a) @ np.abs(b))
    assert error.max() < 2.0**-14
    assert error.max() > 2.0**-24, "in float32 it takes ten times as long"


@pytest.mark.usefixtures("interpreted")
@pytest.mark.parametrize("hidden", [(24,), (64, 64), (16, 8, 20)])
def test_layers(hidden):
    policy, params, samples = problem("normal", hidden)
    assert_equal(by_kernel(policy, 0.0, params, samples), by_xla(policy, 0.0, params, samples))


@pytest.mark.usefixtures("interpreted")
def test_seeds_of_their_own():
    """Parameters, samples and the cost of entropy differ; one more axis shares the samples."""
    made = [problem("normal", seed=k) for k in range(4)]
    policy = made[0][0]
    params, samples = jax.tree.map(lambda *x: jnp.stack(x), *(x[1:] for x in made))
    params = jax.tree.map(lambda x: x.reshape(2, 2, *x.shape[1:]), params)
    samples = jax.tree.map(lambda x: x[:2], samples)
    costs = jnp.array([0.1, 0.4])
    found, expected = (
        jax.jit(jax.vmap(jax.vmap(functools.partial(f, policy), (None, 0, None)), (0, 0, 0)))(
            costs, params, samples
        )
        for f in (by_kernel, by_xla)
    )
    assert_equal(found, expected)


@pytest.mark.usefixtures("interpreted", "on_a_gpu")
def test_seeds_of_a_device():
    """Within ``shard_map``, where JAX says for indices how they are divided."""
    policy, *given = problem("categorical")
    given = jax.tree.map(lambda x: x[None], given)

    def each(params, samples):
        loss = functools.partial(_loss, policy.distribution)
        found = gradient.in_one_kernel(policy, loss, 0.1, params, samples)
        assert found is not None
        return found

    found = Devices(1).jit(jax.vmap(each), (RUNS, RUNS), RUNS)(*given)
    assert_equal(found, jax.vmap(functools.partial(by_xla, policy, 0.1))(*given))


@pytest.mark.usefixtures("interpreted")
def test_what_is_not_finite_shows():
    policy, params, (observation, action, weight, mask) = problem("normal")
    weight = weight.at[3, 4].set(jnp.nan)
    alive, dead = (mask.at[3, 4].set(x) for x in (True, False))
    _, grads, _ = by_kernel(policy, 0.0, params, (observation, action, weight, alive))
    assert np.isnan(grads["network"]["params"]["Dense_0"]["kernel"]).any()
    nothing = jnp.zeros_like(mask)
    value, grads, _ = by_kernel(policy, 0.0, params, (observation, action, weight, nothing))
    assert value == 0
    assert not any(x.any() for x in jax.tree.leaves(grads))
    samples = observation, action, jnp.where(dead, weight, 0.0), dead
    assert_equal(by_kernel(policy, 0.0, params, samples), by_xla(policy, 0.0, params, samples))


@pytest.mark.parametrize("family", FAMILIES)
def test_triton_has_what_it_needs(family, monkeypatch):
    """JAX's part of the compiler takes the kernel, and that of the largest network."""
    # JAX 0.12 asks the device, and finds none here.
    gpu = AbstractDevice(device_kind="NVIDIA H100 80GB HBM3", num_cores=None, platform="cuda")
    mesh = AbstractMesh((1,), ("x",), axis_types=(AxisType.Auto,), abstract_device=gpu)
    launch = kernel.launch

    def launch_there(*given):
        with use_abstract_mesh(mesh):
            return launch(*given)

    monkeypatch.setattr(kernel, "launch", launch_there)
    for made in (problem(family), problem(family, (64, 64, 64))):
        given = jax.tree.map(lambda x: jax.ShapeDtypeStruct((4, *x.shape), x.dtype), made[1:])
        program = jax.jit(jax.vmap(functools.partial(by_kernel, made[0], 0.1)))
        lowered = program.trace(*given).lower(lowering_platforms=("cuda",))
        assert gradient.TRITON in lowered.as_text()


@pytest.mark.usefixtures("interpreted", "on_a_gpu")
@pytest.mark.parametrize("loss_per", ["episode", "step"])
def test_a_learner_takes_it(loss_per, monkeypatch):
    env = envs.make("CartPole-v1")
    found = []
    for least in (10**6, 1):
        monkeypatch.setattr(gradient, "LEAST_SAMPLES", least)
        learner = reinforce(env, num_episodes=4, horizon=20, loss_per=loss_per, entropy_cost=0.1)
        state, metrics = train_step(learner, learner.init(jax.random.key(0)))
        found.append((state.actor.params, metrics["gradient_norm"]))
    assert_equal(found[1], found[0])
    assert any(
        (x != y).any()
        for x, y in zip(jax.tree.leaves(found[0]), jax.tree.leaves(found[1]), strict=True)
    ), "the kernel rounds otherwise; it was not taken"


@pytest.mark.usefixtures("interpreted", "on_a_gpu")
def test_xla_takes_what_cannot_be_written_out(monkeypatch, capsys):
    policy, params, samples = problem("normal")

    def loss(outputs, action, weight, mask, cost):
        value, metrics = _loss(policy.distribution, outputs, action, weight, mask, cost)
        return value + jnp.linalg.svd(outputs[..., None], compute_uv=False)[0] * 0.0, metrics

    fine = functools.partial(_loss, policy.distribution)
    in_one_kernel = gradient.in_one_kernel
    monkeypatch.setenv("MJX_REINFORCE_DEBUG", "1")
    assert in_one_kernel(policy, fine, 0.1, params, samples) is not None
    assert in_one_kernel(policy, loss, 0.1, params, samples) is None
    taken, refused = capsys.readouterr().err.splitlines()
    assert taken == "gradient in one kernel"
    assert refused.startswith("gradient by XLA: UnsupportedPrimitive: ")
    monkeypatch.setattr(gradient, "_capability", lambda: "8.0")
    assert in_one_kernel(policy, fine, 0.1, params, samples) is None
    monkeypatch.undo()
    assert in_one_kernel(policy, fine, 0.1, params, samples) is None, "there is no GPU here"


def test_for_which_policies():
    policy, *_ = problem("normal")
    assert gradient.is_supported(policy, 5)
    other = policy._replace(apply=lambda *given: policy.apply(*given))
    assert not gradient.is_supported(other, 5)
    wrapped = functools.wraps(policy.apply)(lambda params, x: policy.apply(params, 10 * x))
    assert not gradient.is_supported(policy._replace(apply=wrapped), 5)
    assert not gradient.is_supported(problem("normal", (128,))[0], 5)
    assert not gradient.is_supported(problem("normal", ())[0], 5)
    assert not gradient.is_supported(policy, 200)
    with jax.enable_x64(True):
        assert not gradient.is_supported(policy, 5)
