"""The program of a CPU's threads: its text, and that an episode is the same in any lane."""

import jax
import numpy as np
import pytest
from players import actor_and_act, played
from toys import Drifting

from mjx_reinforce.engine.cpu import kernel, machine
from mjx_reinforce.engine.play import available, native, program
from mjx_reinforce.engine.scalar import scalarized

if reason := available.unavailable():
    pytest.skip(reason, allow_module_level=True)
pytestmark = pytest.mark.cpu


def test_what_it_takes_it_frees_and_what_it_flushes_it_undoes():
    env = Drifting()
    actor, act, distribution = actor_and_act(env, ())
    examples = program.step_shapes(env, actor)
    function = program.step_function(env, act, distribution, 4)
    varying = [True] * len(jax.tree.leaves(examples))
    built = scalarized.build(function, examples, varying, program.BRANCH_COST, program.LOOPS)
    work = kernel.player_text(built, len(jax.tree.leaves(actor)), 2).partition("@work(")[2]
    assert work.count("call ptr @malloc") == work.count("call void @free") == 1
    order = "call i64 @flush", "phi i64 [0, ", "call void @unflush", "call void @free"
    assert sorted(order, key=work.index) == list(order)


def test_the_number_of_lanes_changes_nothing(monkeypatch):
    """More episodes than lanes, and fewer; they end at different steps."""
    env, here = Drifting(), machine.this_machine()
    player, options = actor_and_act(env, ()), {"num_episodes": 7, "horizon": 40}
    want = played(native.rollout, env, player, **options)
    assert len(np.unique(want.mask.sum(axis=1))) > 3
    monkeypatch.setattr(machine, "this_machine", lambda: here._replace(lanes=2))
    got = played(native.rollout, env, player, **options)
    for name in ("observation", "action", "reward", "mask"):
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name), err_msg=name)
    assert got.simulated.sum() < want.simulated.sum() or here.lanes <= 2
