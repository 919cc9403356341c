"""The best policy of each seed, by its evaluations so far."""

from types import SimpleNamespace

import jax
import numpy as np

from mjx_reinforce.training.driver import first_best, keep_best, shape_of_best
from mjx_reinforce.training.programs import Looked

STATES = SimpleNamespace(
    actor={"w": np.arange(6.0).reshape(3, 2), "b": np.zeros(3)}, num_updates=np.zeros((3, 2), int)
)


def looked(number, *returns):
    actor = {"w": np.full((3, 2), float(number)), "b": np.full(3, float(number))}
    made = np.tile([0, number], (3, 1))
    return Looked(actor, made, {"eval_return": np.array(returns, np.float32)})


def test_before_the_first_evaluation_every_return_is_better():
    best = first_best(STATES)
    assert best.eval_return.tolist() == [-np.inf] * 3
    best.actor["w"][0, 0] = 9.0  # it has memory of its own
    assert STATES.actor["w"][0, 0] == 0.0
    shapes = jax.tree.map(lambda x: x.shape, shape_of_best(STATES))
    assert shapes == jax.tree.map(lambda x: x.shape, best)


def test_each_seed_keeps_its_own_best_and_of_equals_the_later():
    best = keep_best(first_best(STATES), looked(1, 5, 5, 5))
    best = keep_best(best, looked(2, 4, 5, 6))
    assert best.eval_return.tolist() == [5, 5, 6]
    assert best.actor["w"].tolist() == [[1, 1], [2, 2], [2, 2]]
    assert best.actor["b"].tolist() == [1, 2, 2]
    assert best.num_updates[:, 1].tolist() == [1, 2, 2]


def test_what_is_not_a_number_is_never_the_best():
    best = keep_best(first_best(STATES), looked(1, np.nan, -np.inf, 0))
    assert best.eval_return.tolist() == [-np.inf, -np.inf, 0]
    assert best.actor["w"][:, 0].tolist() == [0, 1, 1]
