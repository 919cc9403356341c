"""Budgets in time: how many env steps a machine trains in it, found at first and again later.

Programs know budgets in env steps alone, so that a run can be repeated. A run in time records each
budget that it had, and from which update on: ``Config.budgets``.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mjx_reinforce.engine import counts
from mjx_reinforce.settings.config import MAX_COUNT, Config
from mjx_reinforce.training.slots import Slots
from mjx_reinforce.training.state import Budget

#: The share of the time in which its speed is measured; what is trained in it is trained again.
_TRIAL_SHARE = 0.03


class _Moment(NamedTuple):
    """How far a trial is.

    seconds: since its start
    env_steps: of the mean seed, those before the trial too
    updates: of the seed with the most, those before the trial too
    """

    seconds: float
    env_steps: float
    updates: int

    @classmethod
    def of(cls, seconds: float, slots: Slots) -> "_Moment":
        """Returns how far the seeds are at this time."""
        states = slots.states().train_states
        env_steps = float(counts.to_int(states.env_steps).mean())
        return cls(seconds, env_steps, int(counts.to_int(states.num_updates).max()))


def env_steps_in(
    seconds: float, slots: Slots, config: Config, interrupted: Callable[[], bool] = lambda: False
) -> int:
    """Returns the env steps that a mean seed will have played in all after a time.

    The seeds are trained, and evaluated, for a small share of that time. The speed of the second
    half of this trial counts: the first updates also have what a device does once, and the shortest
    episodes.

    Args:
      seconds: the time.
      slots: the seeds, where the run goes on.
      config: the settings.
      interrupted: whether the first update of the trial is to be the last.
    """
    max_updates = MAX_COUNT if config.max_updates is None else config.max_updates
    start_time = time.perf_counter()
    moments = [_Moment.of(0.0, slots)]
    # Calls of 1, 2, 4, ... updates: nobody knows yet how long one takes, and so the last call is
    # about half of the trial. The first call does not count as a trial: on a GPU it loads programs.
    # Where it took all of the time, another would only be late.
    trial = 0.0
    while trial < _TRIAL_SHARE * seconds and moments[-1].seconds < seconds:
        if moments[1:] and interrupted():
            break
        num_updates = 2 ** (len(moments) - 1)
        slots.budget = Budget.of(None, min(moments[-1].updates + num_updates, max_updates))
        if not slots.advance(evaluate=False):
            break  # no seed has an update left
        moments.append(_Moment.of(time.perf_counter() - start_time, slots))
        trial = moments[-1].seconds - moments[1].seconds
    start = moments[0]
    end = moments[-1]
    if len(moments) == 1:
        return max(1, round(start.env_steps))
    # The last call alone, if no moment before it is in the second half.
    middle = next((x for x in moments[1:-1] if x.seconds >= end.seconds / 2), moments[-2])
    elapsed = end.seconds - middle.seconds
    # The trial was not evaluated. The run is, after every block, and stands still meanwhile unless
    # evaluations share the launches of updates.
    block_seconds = config.block_length * elapsed / (end.updates - middle.updates)
    slots.seconds_to_evaluate()  # the first has what a device does once
    eval_seconds = slots.seconds_to_evaluate()
    env_steps_per_second = (end.env_steps - middle.env_steps) / elapsed
    env_steps_per_second = env_steps_per_second * block_seconds / (block_seconds + eval_seconds)
    # The trial took its time, and what it trained is undone: the run goes on from its start.
    remaining_seconds = max(seconds - (time.perf_counter() - start_time), 0.0)
    return min(max(1, round(start.env_steps + env_steps_per_second * remaining_seconds)), MAX_COUNT)


#: The budget is found again after each such share of the time. Episodes change their length as a
#: policy learns, and with them the speed.
_SHARE = 1 / 8


class Deadline:
    """When a run is to end, which it does by budgets that are found again and again.

    A policy whose episodes are shorter than others' needs more updates for as many env steps, and
    would go on alone. It is ended late by half of a share of the time, with the env steps it has.
    """

    def __init__(self, start: float, end: float, env_steps: float):
        """Begins where a run begins or goes on.

        Args:
          start: the time at which training begins, or goes on (s).
          end: the time at which it is to end (s).
          env_steps: that the mean policy has played before.
        """
        self._end = end
        self._interval = _SHARE * (end - start)
        self._due = start + self._interval
        self._last = start, env_steps

    def budget(self, seconds: float, env_steps: np.ndarray, present_budget: int) -> int | None:
        """Returns the budget of a policy in env steps, at the speed since the last answer.

        None where no answer is due: a share of the time has not passed, or the end is near.

        Args:
          seconds: the time (s).
          env_steps: [S] that each policy has played.
          present_budget: of a policy, in env steps.
        """
        last_seconds, last_steps = self._last
        mean_steps = float(env_steps.mean())
        latest_seconds = self._end - self._interval / 2
        if mean_steps <= last_steps:
            return None
        if seconds > self._end + self._interval / 2:
            return int(env_steps.min())
        if seconds > latest_seconds:
            return None
        speed = (mean_steps - last_steps) / (seconds - last_seconds)
        # A budget that is nearly used, too early, does not wait until the share has passed.
        is_near = mean_steps >= (1 - _SHARE) * present_budget
        is_early = is_near and seconds + (present_budget - mean_steps) / speed < latest_seconds
        if seconds < self._due and not is_early:
            return None
        self._due = seconds + self._interval
        self._last = seconds, mean_steps
        return min(round(mean_steps + speed * (self._end - seconds)), MAX_COUNT)
