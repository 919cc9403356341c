"""What a user of the Python interface is told, of mistakes and of objects: one line."""

import io
import pydoc

import flax
import jax
import jax.numpy as jnp
import optax
import pytest
from toys import Survive

import mjx_reinforce as m
from mjx_reinforce.settings.defaults import PRESETS

ENV = Survive()
NORMAL = m.normal(ENV.action_space)
LINEAR = m.mlp_policy(1, NORMAL, ())
NAN = float("nan")


def matrix(width):
    """A policy whose outputs are a matrix times the observation."""
    return m.Policy(lambda key: jnp.zeros((1, width)), lambda w, obs: obs @ w, NORMAL)


def weigh(update):
    return m.reward_to_go()._replace(update=update)


#: What is given to ``reinforce``, and what it must say; engine/play/test_contract.py has the rest.
REFUSED = {
    r"must return \[2, 2\]: .* then distribution.constants \[2, 1\], as parameters; got float32": {
        "policy": matrix(1)
    },
    r"must return \[2, 2\].*got float32\[2, 5\]": {"policy": matrix(5)},
    "type Policy, such as mjx_reinforce.mlp_policy.* got a Distribution": {"policy": NORMAL},
    "type Policy.* got mlp_policy": {"policy": m.mlp_policy},
    r"apply\(.*\[2, 1\]\) fails: Scope": {"policy": m.mlp_policy(3, NORMAL)},
    "choose a stochastic one": {"policy": m.mlp_policy(1, m.deterministic(ENV.action_space))},
    r"such as mjx_reinforce.reward_to_go\(0.99\), got 'reward-to-go'": {
        "estimator": "reward-to-go"
    },
    "'rewards'.*test_python_words.py, line": {"estimator": weigh(lambda s, t: (t.rewards, s, {}))},
    r"must return values \[..., 1\], got \[3\]": {
        "estimator": m.value_baseline(network=flax.linen.Dense(3))
    },
    "num_episodes must be at least 1, got 0": {"num_episodes": 0},
    "num_episodes must be a whole number, got 16.0": {"num_episodes": 16.0},
    "horizon must be a whole number, got 1000.0": {"horizon": 1e3},
    r"such as optax.adam\(1e-2\), got adam": {"optimizer": optax.adam},
    "got full_batch, which is to be called": {"update": m.full_batch},
    "entropy_cost must be 0 or more and finite, got nan": {"entropy_cost": NAN},
    "normalize_steps must be 0 or more, got nan": {"normalize_steps": NAN},
    "max_kl must be positive, got 0": {"max_kl": 0},
    r"policy must be of type Policy, .* got a tuple": {"policy": ()},
    "update must be such as .* got False": {"update": False},
}


@pytest.mark.parametrize("message", REFUSED)
def test_a_learner_is_refused(message, monkeypatch):
    """When it is built, and before anything is compiled."""
    monkeypatch.setattr(
        "mjx_reinforce.engine.play.choice.choose", lambda *_: pytest.fail("it was not refused")
    )
    with pytest.raises(ValueError, match=message) as error:
        m.reinforce(ENV, **REFUSED[message])
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: m.reinforce(Survive), "Survive is a class, not an environment yet: call it"),
        (lambda: m.ars(ENV, policy=m.mlp_policy(3, NORMAL)), "policy.apply"),
        (lambda: m.ars(ENV, num_directions=True), "num_directions must be a whole number, got T"),
        (lambda: m.ars(ENV, num_directions=2.5), "num_directions must be a whole number.* got 2.5"),
        (lambda: m.ars(ENV, step_size=NAN), "step_size must be positive and finite, got nan"),
        (lambda: m.reward_to_go(NAN), r"must lie in \[0, 1\], got nan"),
        (lambda: m.leave_one_out(ENV), r"must lie in \[0, 1\], got <toys.Survive"),
        (lambda: m.standardize("reward-to-go"), "type Estimator.* got 'reward-to-go'"),
        (lambda: m.standardize(m.reward_to_go(), floor=NAN), "floor must be 0 or more, got nan"),
        (lambda: m.discount_weights(0.9), "type Estimator.* got a float"),
        (lambda: m.normal(ENV), "such as env.action_space, .* got a Survive"),
        (lambda: m.categorical(2), "categorical needs an action space"),
        (lambda: m.normal(ENV.action_space, initial_std="a"), "positive and finite, got 'a'"),
        (lambda: m.mlp_policy(NORMAL, 1), "observation_size must be a whole number"),
        (lambda: m.mlp_policy(1, ENV.action_space), "type Distribution.* got a Box"),
        (lambda: m.mlp_policy(1, NORMAL, 32), "hidden_sizes must be a tuple.* got 32"),
        (lambda: m.minibatches(2.5, 3), "num_updates must be a whole number, got 2.5"),
        (lambda: m.make_optimizer("adam", "0.1"), "learning_rate must be 0 or more .* got '0.1'"),
        (lambda: m.make_optimizer(1e-2), r"name comes first, got 0.01: write learning_rate="),
        (lambda: jax.vmap(m.make_optimizer)(jnp.ones(2)), "write learning_rate="),
        (lambda: m.load(3), "run must be text or Path, got 3"),
    ],
)
def test_a_part_is_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


@pytest.fixture(scope="module")
def learner():
    return m.reinforce(ENV, policy=LINEAR, engine="vmap")


@pytest.fixture(scope="module")
def state(learner):
    return learner.init(jax.random.key(0))


def play(learner, state, **changes):
    given = {"env": ENV, "act": learner.act, "actor": state.actor, "distribution": NORMAL}
    given |= {"key": jax.random.key(0), "num_episodes": 2, "horizon": 20} | changes
    return m.rollout(**given)


def test_a_rollout_is_refused(learner, state):
    for changes, message in (
        ({"env": Survive}, "Survive is a class"),
        ({"act": LINEAR}, "act must be a function, such as learner.act, got a Policy"),
        ({"distribution": LINEAR}, "functions noise, sample and mode, .* got Policy"),
        ({"key": 0}, r"a random key, such as jax.random.key\(0\), got 0"),
        ({"num_episodes": 0}, "num_episodes must be at least 1"),
        ({"horizon": 20.0}, "horizon must be a whole number, got 20.0"),
    ):
        with pytest.raises(ValueError, match=message):
            play(learner, state, **changes)


def test_acting_and_learning_are_refused(learner, state):
    with pytest.raises(ValueError, match=r"must be \[..., 1\], got one of shape \[3\]"):
        m.act(LINEAR, state.actor, jnp.zeros(3))
    with pytest.raises(ValueError, match=r"such as state.actor, got a dict"):
        m.act(LINEAR, state.actor.params, jnp.zeros(1))
    with pytest.raises(ValueError, match=r"such as learner.policy, got a Learner"):
        m.act(learner, state.actor, jnp.zeros(1))
    with pytest.raises(ValueError, match=r"random key"):
        learner.init(0)
    with pytest.raises(ValueError, match=r"such as learner.init.* got a NoneType"):
        m.train_step(learner, None)


def test_an_object_is_one_short_line(learner, state):
    shapes = jax.eval_shape(lambda: play(learner, state))
    seeds = jax.eval_shape(jax.vmap(learner.init), jax.random.split(jax.random.key(0), 8))
    made = m.envs.make("CartPole-v1"), m.envs.make("CartPole-v0")
    presets = (config for _, config in PRESETS.values())
    parts = learner, state, seeds, LINEAR, NORMAL, m.reward_to_go(), shapes
    for thing in (*parts, *made, *presets):
        assert repr(thing).startswith(f"{type(thing).__name__}(")
        assert len(repr(thing)) < 500
        assert "\n" not in repr(thing)
        assert " at 0x" not in repr(thing)
    assert repr(seeds).endswith("seeds [8])")
    assert "mask bool[20, 2]" in repr(shapes)
    assert [repr(env) for env in made] == [
        "CartPole()",
        "CartPole(max_episode_steps=200, reward_threshold=195.0)",
    ]


def test_modules_are_attributes():
    assert m.envs.names()
    assert m.engine.vmap
    assert m.reports.__name__ == "mjx_reinforce.reports"
    assert {"envs", "reinforce"} <= set(dir(m))
    with pytest.raises(AttributeError, match=r"has no attribute 'nonsense'"):
        m.nonsense  # noqa: B018


def test_help_says_it():
    for name, words in (
        ("reinforce", "sum_n sum_t (w[t, n] log pi(a[t, n] | o[t, n])"),
        ("train_step", "train_step(learner"),
        ("Policy", "distribution.constants"),
    ):
        text = io.StringIO()
        pydoc.Helper(output=text).help(getattr(m, name))
        shown = text.getvalue()
        # Python 3.13 breaks a long signature into lines.
        assert words in " ".join(shown.split()).replace("( ", "(")
        assert "_train_step" not in shown.replace("mjx_reinforce", "")
        assert "top of this file" not in shown


@pytest.mark.parametrize("engine", ["vmap", "native"])
def test_a_mask_of_several_seeds_is_refused(engine):
    """Machine code took its length for the number of seeds, and wrote beyond its buffers."""
    learner = m.reinforce(Survive(), num_episodes=4, engine=engine)
    state = learner.init(jax.random.key(0))
    with pytest.raises(ValueError, match=r"active must be \[\] or \[4\], got the shape \[3\]"):
        learner.play(state, jax.random.key(1), jnp.ones(3, bool))


def test_states_and_actions_of_another_shape_are_refused():
    env = m.envs.make("InvertedPendulum-v5")
    with pytest.raises(ValueError, match=r"qpos must be \[2\], got the shape \[1\]"):
        env.set_state(jnp.zeros(1), jnp.zeros(2))
    with pytest.raises(ValueError, match=r"the action must be \[1\], got the shape \[3\]"):
        jax.eval_shape(env.step, env.set_state(jnp.zeros(2), jnp.zeros(2)), jnp.zeros(3))
