"""The loop of a run: in which order it trains and evaluates, who sees it, and when it ends."""

from types import SimpleNamespace

import numpy as np

from mjx_reinforce.engine import counts
from mjx_reinforce.learning.learner import TrainState
from mjx_reinforce.settings.config import Config
from mjx_reinforce.training.driver import RunDriver, Runs
from mjx_reinforce.training.record import Measured
from mjx_reinforce.training.run_record import RunRecord
from mjx_reinforce.training.state import Best, first_best, keep_best

BLOCK = 2
RUNS = Runs("000-0000", *np.zeros((3, 2), int))
CONFIG = Config(num_seeds=2, env_steps=None, max_updates=3 * BLOCK, eval_every=BLOCK)


class Steps:
    """Slots whose state is a number of updates; policies return ``returns(number)``."""

    def __init__(self, returns=lambda updates: [updates, -updates], broken=False):
        self.returns, self.broken, self.evaluated, self.number = returns, broken, [], 0

    def states(self):
        made = np.stack([np.asarray(counts.from_int(self.number))] * 2)
        actor = {"w": np.full(2, self.number, np.float32)}
        train_states = TrainState(key=np.zeros(2), actor=actor, num_updates=made)
        return SimpleNamespace(
            train_states=train_states.replace(progress=np.zeros(2), env_steps=made)
        )

    layout = SimpleNamespace(layout="a number")

    def rows(self):
        return np.array([[self.number]])

    def restore(self, rows):
        self.number = int(rows[0, 0])

    def eval_metrics(self):
        names = ("eval_return", "eval_return_stochastic", "eval_length")
        zeros = {name: np.zeros(2, np.int32) for name in ("simulated_steps", "eval_steps")}
        return {name: np.asarray(self.returns(self.number), np.float32) for name in names} | zeros

    def evaluate(self):
        return Measured(np.arange(2), {}, self.eval_metrics())

    def advance(self, chosen, lengths, evaluate, max_blocks):
        self.evaluated.append(evaluate)
        eval_metrics = self.eval_metrics() if evaluate else {}
        ones = np.ones((BLOCK, 2), np.int32)
        metrics = dict.fromkeys(("env_steps", "episodes", "simulated_steps"), ones)
        metrics |= {
            "active": ones.astype(bool),
            "episode_return": ones.astype(np.float32),
            "nonfinite_episodes": ones * self.broken,
            "skipped_update": ones * self.broken,
        }
        self.number += BLOCK
        return [Measured(np.arange(2), metrics, eval_metrics)]

    def test(self, actor):
        return {"eval_return": actor["w"] * 10.0}


class Diary:
    """Notes what happens, and asks for the end after so many evaluations."""

    def __init__(self, until=99):
        self.notes, self.until = [], until

    def updated(self, driver, met):
        self.notes.append(f"updated {driver.updates()}")

    def evaluated(self, driver, evaluation, rows):
        self.notes.append(f"evaluated {evaluation.updates[0]}")
        driver.ended = self.notes.count("evaluated 0") + len(self.notes) > self.until


def driver_of(steps, *observers, config=CONFIG, threshold=None):
    record = RunRecord(config, threshold)
    record.count_steps = lambda eval_metrics: None
    return RunDriver(config, steps, record, RUNS, observers)


def never():
    return False


def after(number):
    """Interrupts after so many questions."""
    answers = iter([False] * number)
    return lambda: next(answers, True)


def test_the_first_and_the_last_policies_are_evaluated_alone_and_others_with_the_next_updates():
    steps, diary = Steps(), Diary()
    driver = driver_of(steps, diary)
    driver.drive(never)
    assert steps.evaluated == [False, True, True]
    assert diary.notes == [
        *("evaluated 0", "updated 2", "evaluated 2", "updated 4", "evaluated 4", "updated 6"),
        "evaluated 6",
    ]
    assert driver.record.history()["eval_return"][:, 0].tolist() == [0, 2, 4, 6]


def test_the_best_policy_is_each_seed_s_own():
    driver = driver_of(Steps())
    driver.drive(never)
    assert driver.best.eval_return.tolist() == [6, 0]
    assert driver.best.actor["w"].tolist() == [6, 0]
    assert driver.test(never) == {
        "final_test_returns": [60.0, 60.0],
        "best_test_returns": [60.0, 0.0],
    }


def test_an_interrupted_block_is_not_evaluated_unless_nothing_was():
    steps, diary = Steps(), Diary()
    driver_of(steps, diary).drive(after(2))
    assert diary.notes[-1] == "updated 4"
    first = Diary()
    driver_of(Steps(), first).drive(after(0))
    assert first.notes == ["evaluated 0"]


def test_an_interrupted_test_says_nothing():
    driver = driver_of(Steps())
    assert driver.test(after(0)) == driver.test(after(1)) == {}


def test_an_observer_ends_the_run():
    diary = Diary(until=3)
    driver = driver_of(Steps(), diary)
    driver.drive(never)
    assert driver.ended
    assert driver.updates() == 4
    assert diary.notes[-1] == "evaluated 4"


def test_a_run_without_a_finite_update_ends():
    config = Config(**{**vars(CONFIG), "max_updates": 100})
    driver = driver_of(Steps(broken=True), config=config)
    driver.drive(never)
    assert driver.updates() == 6  # five are enough


def test_a_restored_run_goes_on_where_it_was():
    half, rest = Steps(), Steps()
    first = driver_of(half)
    first.drive(after(2))
    found = first.checkpoint()._replace(seconds=100.0)
    second = driver_of(rest)
    second.restore(found)
    assert second.updates() == 4
    assert second.seconds() >= 100.0
    second.drive(never)
    assert rest.evaluated == [True]
    assert second.record.history()["eval_return"][:, 0].tolist() == [0, 2, 4, 6]


# The best policy of each seed, by its evaluations so far.


STATES = SimpleNamespace(
    actor={"w": np.arange(6.0).reshape(3, 2), "b": np.zeros(3)}, num_updates=np.zeros((3, 2), int)
)


def best_of(number, *returns):
    actor = {"w": np.full((3, 2), float(number)), "b": np.full(3, float(number))}
    made = np.tile([0, number], (3, 1))
    return Best(actor=actor, eval_return=np.array(returns, np.float32), num_updates=made)


def test_before_the_first_evaluation_every_return_is_better():
    best = first_best(STATES)
    assert best.eval_return.tolist() == [-np.inf] * 3
    best.actor["w"][0, 0] = 9.0  # it has memory of its own
    assert STATES.actor["w"][0, 0] == 0.0


def test_each_seed_keeps_its_own_best_and_of_equals_the_later():
    best = keep_best(first_best(STATES), best_of(1, 5, 5, 5))
    best = keep_best(best, best_of(2, 4, 5, 6))
    assert best.eval_return.tolist() == [5, 5, 6]
    assert best.actor["w"].tolist() == [[1, 1], [2, 2], [2, 2]]
    assert best.actor["b"].tolist() == [1, 2, 2]
    assert best.num_updates[:, 1].tolist() == [1, 2, 2]


def test_what_is_not_a_number_is_never_the_best():
    best = keep_best(first_best(STATES), best_of(1, np.nan, -np.inf, 0))
    assert best.eval_return.tolist() == [-np.inf, -np.inf, 0]
    assert best.actor["w"][:, 0].tolist() == [0, 1, 1]
