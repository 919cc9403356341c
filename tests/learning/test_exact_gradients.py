"""Each estimator's expected gradient on a small Markov process against the exact one, in float64.

The gradients that ``learn`` makes of all batches of episodes that there can be are averaged with
the batches' probabilities. Nothing is sampled, so they agree to rounding.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from toys import Chain, tabular_policy

from mjx_reinforce import Trajectory, reinforce
from mjx_reinforce.learning import estimators as est
from mjx_reinforce.learning.policy import MLP
from mjx_reinforce.learning.value import full_batch_value_baseline, value_baseline
from mjx_reinforce.published import variants

#: How likely each state, or the end, follows a state and an action; and what these earn.
NEXT = np.array(
    [
        [[0.0, 0.7, 0.0, 0.3], [0.5, 0.0, 0.5, 0.0]],
        [[0.0, 0.0, 0.6, 0.4], [1.0, 0.0, 0.0, 0.0]],
        [[0.0, 0.0, 0.0, 1.0], [0.2, 0.8, 0.0, 0.0]],
    ]
)
REWARD = np.array([[1.0, -0.5], [2.0, 0.7], [-1.0, 3.0]])
LOGITS = np.array([[0.2, -0.1], [0.5, 0.3], [-0.4, 0.1]])
HORIZON = 3


def probabilities(logits):
    return np.exp(logits) / np.sum(np.exp(logits), axis=1, keepdims=True)


def episodes(limit, states=(0,), actions=(), chance=1.0):
    """Yields states, actions and the probability of what follows them; the policy's is left out."""
    for action in (0, 1):
        after, done = NEXT[states[-1], action], (*actions, action)
        if len(done) == limit:
            yield states, done, chance
            continue
        if after[3]:
            yield states, done, chance * after[3]
        for state in np.flatnonzero(after[:3]):
            yield from episodes(limit, (*states, state), done, chance * after[state])


def likelihood(logits, episode):
    states, actions, chance = episode
    return chance * np.prod(probabilities(logits)[list(states), list(actions)])


def gradient(function):
    """Returns the derivatives by the logits: the complex step, which is exact."""
    steps = 1e-30j * np.eye(6).reshape(6, 3, 2)
    return np.array([np.imag(function(LOGITS + step)) for step in steps]).reshape(3, 2) / 1e-30


def values(logits, limit, discount, reward):
    """Returns Q [L, 3, 2] by dynamic programming."""
    q = [np.zeros((3, 2))]
    for _ in range(limit):
        v = np.sum(probabilities(logits) * q[0], axis=1)
        q.insert(0, reward + discount * NEXT[..., :3] @ v)
    return np.array(q[:-1])


def of_the_start(limit, discount, reward=REWARD):
    """Returns the gradient of the discounted return from the start."""
    return gradient(
        lambda logits: probabilities(logits)[0] @ values(logits, limit, discount, reward)[0, 0]
    )


def of_all_steps(limit, discount, reward=REWARD):
    """Returns the same without discount^t: how each step's own action changes what follows it."""
    policy, total, reach = probabilities(LOGITS), 0.0, np.array([1.0, 0.0, 0.0])
    for q in values(LOGITS, limit, discount, reward):
        total = total + reach[:, None] * policy * (q - np.sum(policy * q, axis=1, keepdims=True))
        reach = np.einsum("s,sa,san->n", reach, policy, NEXT[..., :3])
    return total


def to_go(episode, discount):
    states, actions, _ = episode
    earned = [REWARD[s, a] for s, a in zip(states, actions, strict=True)]
    return [sum(discount**k * r for k, r in enumerate(earned[t:])) for t in range(len(earned))]


def of_mean_to_go(limit, discount):
    """Returns the gradient of E[sum_t G[t] / L]."""
    each = [(episode, np.mean(to_go(episode, discount))) for episode in episodes(limit)]
    return gradient(lambda logits: sum(likelihood(logits, e) * mean for e, mean in each))


def of_weights(weigh):
    """Returns the expectation of a formula: of G of a batch's steps, to its weights."""

    def expected(limit, discount):
        total = np.zeros((3, 2))
        for batch in itertools.product(list(episodes(limit)), repeat=2):
            weight = weigh([to_go(episode, discount) for episode in batch])
            likely = np.prod([likelihood(LOGITS, episode) for episode in batch])
            for (states, actions, _), own in zip(batch, weight, strict=True):
                for state, action, w in zip(states, actions, own, strict=True):
                    score = np.eye(2)[action] - probabilities(LOGITS)[state]
                    total[state] += likely * w * score / 2
        return total

    return expected


def normalized(batch):
    ddof = [min(len(g) - 1, 1) for g in batch]
    return [
        (g - np.mean(g)) / (np.std(g, ddof=d) + np.finfo(np.float32).eps)
        for g, d in zip(batch, ddof, strict=True)
    ]


def standardized(batch):
    mean, std = np.mean(np.concatenate(batch)), np.std(np.concatenate(batch))
    return [(np.array(g) - mean) / (std + 0.5) for g in batch]


def to_trajectory(batches):
    """Returns batches of episodes, with nonsense behind their ends."""
    played = {episode: n for n, episode in enumerate(dict.fromkeys(itertools.chain(*batches)))}
    which = np.array([[played[episode] for episode in batch] for batch in batches])
    shape = len(played), HORIZON
    seen, action, mask = np.full((*shape, 3), 9.0), np.ones(shape, int), np.zeros(shape, bool)
    for (states, actions, _), n in played.items():
        length = len(states)
        seen[n, :length], action[n, :length] = np.eye(3)[list(states)], actions
        mask[n, :length] = True
    reward = np.where(mask, REWARD[np.argmax(seen, axis=-1), action], 0.0)
    arrays = {"observation": seen, "action": action, "reward": reward, "mask": mask}
    return Trajectory(
        **{name: jnp.asarray(np.moveaxis(x[which], 1, 2)) for name, x in arrays.items()},
        nonfinite=jnp.zeros(which.shape, bool),
        simulated=jnp.zeros(len(which), int),
    )


def fitted(estimator):
    """Begins with what its critic learned from two other episodes."""
    trajectory = to_trajectory([[next(episodes(3)), next(episodes(2))]])
    before = jax.tree.map(lambda x: x[0], trajectory)

    def init(key, observation_size):
        return estimator.update(estimator.init(key, observation_size), before)[1]

    return estimator._replace(init=init)


CRITIC = {"network": MLP((4,), 1), "num_fits": 2, "optimizer": optax.adam(0.2)}
#: An estimator of a discount, what it is to give, and the number of episodes.
CASES = {
    "total return": (est.total_return, of_the_start, 1),
    "reward to go": (est.reward_to_go, of_all_steps, 1),
    "leave one out": (est.leave_one_out, of_all_steps, 3),
    "of the living": (est.leave_one_out_alive, of_all_steps, 3),
    "value": (lambda d: fitted(value_baseline(d, batch_size=8, **CRITIC)), of_all_steps, 1),
    "full-batch": (lambda d: fitted(full_batch_value_baseline(d, **CRITIC)), of_all_steps, 1),
    "discount^t": (lambda d: est.discount_weights(est.leave_one_out(d), d), of_the_start, 2),
    "mean log-prob": (variants.mean_log_prob, of_mean_to_go, 1),
    "normalized": (variants.normalized_returns, of_weights(normalized), 1),
    "standardized": (
        lambda d: est.standardize(est.reward_to_go(d), floor=0.5, center=True),
        of_weights(standardized),
        2,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_the_expected_gradient_is_the_exact_one(case):
    """Of episodes up to the horizon and of those that were cut, with and without a discount."""
    make, expected, number = CASES[case]
    parts = {
        limit: list(itertools.product(list(episodes(limit)), repeat=number))
        for limit in (HORIZON, HORIZON - 1)
    }
    batches = list(itertools.chain(*parts.values()))

    def learned(discount, trajectory):
        learner = reinforce(
            Chain(),
            policy=tabular_policy()._replace(init=lambda key: jnp.asarray(LOGITS)),
            estimator=make(discount),
            optimizer=optax.sgd(1.0),
            num_episodes=number,
            normalize_steps=0,
        )
        state = learner.init(jax.random.key(0))
        learn = jax.vmap(learner.learn, (None, 0, None))
        return learn(state, trajectory, jax.random.key(1))[0].actor.params - LOGITS

    with jax.enable_x64(True):
        learned, trajectory = jax.jit(learned), to_trajectory(batches)
        for discount in (0.8, 1.0):
            moved = iter(np.asarray(learned(discount, trajectory)))
            for limit, part in parts.items():
                likely = [np.prod([likelihood(LOGITS, e) for e in batch]) for batch in part]
                assert sum(likely) == pytest.approx(1.0, rel=1e-12)
                got = sum(p * next(moved) for p in likely)
                np.testing.assert_allclose(got, expected(limit, discount), rtol=0, atol=1e-12)
