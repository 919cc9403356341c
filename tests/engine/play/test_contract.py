"""What an environment, a policy and an estimator must do; what they do not is named in one line."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import Chain, Toy, tabular_policy

import mjx_reinforce as m
from mjx_reinforce import Box, Discrete
from mjx_reinforce.engine import checks
from mjx_reinforce.engine.checks import BadEnvironmentError
from mjx_reinforce.engine.contract import check_environment
from mjx_reinforce.learning.contract import check_estimator, check_policy, check_update
from mjx_reinforce.learning.estimators import Estimator


def toy(**parts):
    """A toy with other parts; ``reset`` and ``step`` get the state of the toy's own."""
    made = Toy()
    for name, value in parts.items():
        if name in ("reset", "step"):
            own = getattr(made, name)
            value = lambda *x, own=own, change=value: change(own(*x))  # noqa: E731
        setattr(made, name, value)
    return made


@pytest.mark.parametrize("env", [Toy(), Chain(), toy(max_episode_steps=None)])
def test_what_can_be_played_passes(env):
    check_environment(env)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"max_episode_steps": 0}, "max_episode_steps must be a whole number, 1 or more, got 0"),
        ({"reward_threshold": "high"}, "reward_threshold must be a number or None"),
        ({"action_size": 0}, "action_size must be a whole number"),
        ({"action_space": Discrete(3)}, "action_size is 1, but its action_space has 3 actions"),
        ({"action_space": Box(np.zeros(1), np.zeros(1))}, "must have low < high"),
        ({"action_space": (-1, 1)}, r"action_space is a builtins.tuple; make it a mjx_reinforce"),
        ({"reset": lambda s: s.replace(obs=None)}, "whose obs is a vector .* there is no obs"),
        ({"reset": lambda s: s.replace(obs=jnp.ones((1, 2)))}, "its shape is .1, 2.; concatenate"),
        ({"reset": lambda s: s.replace(done=jnp.ones(2))}, "the done of .* reduce it"),
        ({"step": lambda s: s.replace(info=jnp.ones(1))}, "info only after step"),
        ({"step": lambda s: s.replace(obs=jnp.ones(2))}, r"obs is float32\[1\] .* float32\[2\]"),
        ({"step": lambda s: s.replace(obs=s.obs if s.reward > 0 else -s.obs)}, "write jnp.where"),
        ({"step": lambda s: 1 / 0}, "Toy.step fails: .*division by zero"),
    ],
)
def test_what_cannot_be_played_is_named(parts, message):
    with pytest.raises(BadEnvironmentError, match=message):
        check_environment(toy(**parts))


def test_a_wider_state_may_be_kept_in_place_of_a_narrower_one_only():
    check_environment(toy(step=lambda s: s.replace(reward=s.reward.astype(jnp.float16))))
    with pytest.raises(BadEnvironmentError, match=r"reward is float16\[\] after reset"):
        check_environment(toy(reset=lambda s: s.replace(reward=s.reward.astype(jnp.float16))))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"init": lambda key: 1 / 0}, r"policy.init\(key\) fails"),
        (
            {"apply": lambda params, x: (x @ params)[:, :1]},
            r"return \[2, 2\].*got float32\[2, 1\]",
        ),
        ({"apply": lambda params, x: (x @ params).astype(int)}, "floating-point numbers, got int"),
        ({"distribution": 3}, "policy.distribution must be"),
    ],
)
def test_a_policy_that_cannot_play_is_named(change, message):
    with pytest.raises(ValueError, match=message):
        check_policy(tabular_policy()._replace(**change), Chain(), 3)


def test_a_policy_of_other_actions_is_named():
    with pytest.raises(ValueError, match=r"draws actions int32\[2\] .* Toy takes \[2, 1\]"):
        check_policy(tabular_policy(), Toy(), 3)


def test_a_likelihood_is_asked_for_where_it_is_needed():
    def fails(outputs, action):
        raise NotImplementedError("no density")

    policy = tabular_policy()
    policy = policy._replace(distribution=policy.distribution._replace(log_prob=fails))
    check_policy(policy, Chain(), 3)
    with pytest.raises(ValueError, match=r"log_prob fails: .*no density"):
        check_policy(policy, Chain(), 3, likelihood=True)


def estimator(update):
    return Estimator(lambda key, observation_size: (), update, min_episodes=2)


@pytest.mark.parametrize(
    ("update", "message"),
    [
        (lambda state, t: 1 / 0, "estimator.init or update fails"),
        (lambda state, t: (t.reward, state), "must return three things"),
        (lambda state, t: (t.reward[0], state, {}), r"here \[5, 4\]; got float32\[4\]"),
        (lambda state, t: (t.reward, state, ()), "metrics as a dict, got tuple"),
    ],
)
def test_an_estimator_whose_weights_do_not_fit_is_named(update, message):
    with pytest.raises(ValueError, match=message):
        check_estimator(estimator(update), Chain(), 3, 4)


def test_an_estimator_needs_so_many_episodes():
    with pytest.raises(ValueError, match="at least 2 episodes per update, got num_episodes=1"):
        check_estimator(m.leave_one_out(0.9), Chain(), 3, 1)


def test_what_is_no_update_is_named():
    check_update(m.full_batch())
    with pytest.raises(ValueError, match="got full_batch, which is to be called"):
        check_update(m.full_batch)
    with pytest.raises(ValueError, match="got 3"):
        check_update(3)


# -------------------------------------------------------------------------------------------------
# Checks of numbers and keys: what is no number is refused, what is traced is taken on trust.


@pytest.mark.parametrize("value", [True, "2", None, [1, 2], math.nan, np.ones(2)])
def test_what_is_no_number_is_nan(value):
    assert math.isnan(checks.known_number(value))
    with pytest.raises(ValueError, match="step must be 0 or more and finite"):
        checks.check_number("step", value)


def test_what_is_traced_is_taken_on_trust():
    def traced(x):
        assert checks.known_number(x) is None
        checks.check_number("step", x, positive=True)
        return x

    jax.jit(traced)(-1.0)


def test_the_range_of_a_number():
    checks.check_number("step", 0)
    checks.check_number("step", math.inf, finite=False)
    with pytest.raises(ValueError, match=r"step must be positive and finite, got 0"):
        checks.check_number("step", 0, positive=True)
    with pytest.raises(ValueError, match=r"step must be 0 or more, got -1"):
        checks.check_number("step", -1, finite=False)
    with pytest.raises(ValueError, match="finite, got inf"):
        checks.check_number("step", math.inf)
