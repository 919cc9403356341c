"""The program of a CPU's threads: its text, and that an episode is the same in any lane."""

import re

import jax
import numpy as np
import pytest
from players import actor_and_act, played
from toys import Drifting

from mjx_reinforce.engine.cpu import handler, kernel, machine
from mjx_reinforce.engine.play import available, native, program
from mjx_reinforce.engine.scalar import scalarized

if reason := available.unavailable():
    pytest.skip(reason, allow_module_level=True)
pytestmark = pytest.mark.cpu


@pytest.fixture(scope="module")
def text():
    """(lanes, flush) -> the program that plays a small task."""
    env = Drifting()
    actor, act, distribution = actor_and_act(env, ())
    examples = program.step_shapes(env, actor)
    function = program.step_function(env, act, distribution, 4)
    varying = [True] * len(jax.tree.leaves(examples))
    built = scalarized.build(function, examples, varying, program.BRANCH_COST, program.LOOPS)
    num_actor = len(jax.tree.leaves(actor))
    return lambda lanes, flush: kernel.player_text(built, num_actor, lanes, flush)


def test_what_it_takes_it_frees_and_what_it_flushes_it_undoes(text):
    work = text(2, handler.flush("x86_64-unknown-linux-gnu")).partition("@work(")[2]
    assert work.count("call ptr @malloc") == work.count("call void @free") == 1
    set_at, undone_at = (found.start() for found in re.finditer("call void @llvm.x86.sse.ld", work))
    assert set_at < work.index("phi i64 [0, ") < undone_at < work.index("call void @free")


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
