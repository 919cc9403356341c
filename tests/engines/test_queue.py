"""How a lane begins and ends an episode: its column of the memory, after each call."""

import ctypes
import re

import jax
import numpy as np
import pytest

from mjx_reinforce.engines.native import plays
from mjx_reinforce.engines.native.cpu import handler
from mjx_reinforce.engines.native.cpu.lanes import layout
from mjx_reinforce.engines.native.cpu.queue import queue_text

llvm = pytest.importorskip("llvmlite.binding", reason="machine code is written by llvmlite")

LANES, S, N = 2, 2, 3
SKIP, SAMPLE, MODE = plays.NOT_PLAYED, 7, -8  # at most so many steps
ACTOR = [("f4", 3), ("f4", 0), ("f8", 2)]
STATE = [("f4", 2), ("i8", 1)]
OTHERS = [("u4", 4), ("i4", 1), ("i4", 1), ("i4", 1)]
LEAVES = [jax.ShapeDtypeStruct((n,), np.dtype(kind)) for kind, n in ACTOR + STATE + OTHERS]
PLACES = layout(LEAVES, len(ACTOR), len(STATE), LANES)


@pytest.fixture(scope="module")
def functions():
    """``begin``, ``finish`` and ``settle`` for Python to call."""
    text = handler.handler_text(7, [4] * 6, LANES)
    text += re.sub("define internal", "define", queue_text(PLACES, LANES))
    text += "define void @work(ptr %job) {\nret void\n}\n"
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    module = llvm.parse_assembly(text)
    module.verify()
    machine = llvm.Target.from_default_triple().create_target_machine(opt=0, jit=True)
    engine = llvm.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    names = {"begin": 0, "finish": 0, "settle": 1}
    pointers, number = [ctypes.c_void_p] * 2, [ctypes.c_int64]
    made = {
        name: ctypes.CFUNCTYPE(None, *pointers, *number, *(number * more))(
            engine.get_function_address(name)
        )
        for name, more in names.items()
    }
    return made | {"engine": engine}


class Game:
    """A job and the memory of one thread, whose lanes have played nothing yet."""

    def __init__(self, functions, play):
        rng = np.random.default_rng(0)
        self.functions, play = functions, np.asarray(play, np.int32)
        self.actor = [rng.normal(size=(S, n)).astype(kind) for kind, n in ACTOR if n]
        self.state = [(9 * rng.normal(size=(play.size, n))).astype(kind) for kind, n in STATE]
        self.keys = rng.integers(1, 99, (play.size, 2)).astype(np.uint32)
        self.length, self.broken = (np.full(play.size, -7, np.int32) for _ in range(2))
        self.simulated = np.zeros(S, np.int32)
        unused = np.zeros(1, np.float32)
        given = [play, unused, self.keys, *self.actor, *self.state]
        results = [unused] * 3 + [self.length, self.broken, self.simulated]
        self.buffers = given + results
        addresses = [x.ctypes.data for x in self.buffers]
        self.data = (ctypes.c_void_p * len(addresses))(*addresses)
        job = dict.fromkeys(handler.FIELDS, 0) | {"total": play.size, "episodes": N}
        job["data"] = ctypes.addressof(self.data)
        self.job = np.array([job[name] for name in handler.FIELDS], np.int64)
        self.memory = np.zeros(PLACES.size, np.uint8)
        self.column(PLACES.seed)[:] = -1

    def column(self, field, lane=slice(None)):
        size = field.count * LANES * field.dtype.itemsize
        part = self.memory[field.offset : field.offset + size].view(field.dtype)
        return part.reshape(field.count, LANES)[:, lane]

    def call(self, name, *numbers):
        self.functions[name](self.job.ctypes.data, self.memory.ctypes.data, *numbers)

    def end(self, lane, steps, broken=0):
        """Ends the episode of a lane."""
        self.column(PLACES.step, lane)[0] = steps
        self.column(PLACES.broken, lane)[0] = broken
        self.call("finish", lane)

    def flags(self, lane):
        """Alive, deterministic, seed, episode, steps taken."""
        fields = (PLACES.alive, PLACES.deterministic, PLACES.seed, PLACES.episode, PLACES.step)
        return [int(self.column(field, lane)[0]) for field in fields]

    def check_values(self, lane, item):
        """The lane has actor, state and key of an item."""
        for field, array in zip(PLACES.actor_fields, self.actor, strict=True):
            np.testing.assert_array_equal(self.column(field, lane), array[item // N])
        for field, array in zip(PLACES.state_fields, self.state, strict=True):
            np.testing.assert_array_equal(self.column(field, lane), array[item])
        np.testing.assert_array_equal(self.column(PLACES.key, lane), self.keys[item])


@pytest.fixture
def game(functions):
    return Game(functions, [SAMPLE, SKIP, MODE, MODE, SAMPLE, SAMPLE])


def test_lanes_begin_with_the_next_episodes_that_are_played(game):
    game.column(PLACES.step)[:] = 9
    for lane in range(LANES):
        game.call("begin", lane)
    assert [game.flags(lane) for lane in range(LANES)] == [[1, 0, 0, 0, 0], [1, 1, 0, 2, 0]]
    assert game.column(PLACES.limit).tolist() == [[7, 8]]
    game.check_values(0, 0)
    game.check_values(1, 2)


def test_an_episode_that_ends_is_written_down_and_followed_by_the_next(game):
    for lane in range(LANES):
        game.call("begin", lane)
    game.end(1, 5, broken=1)
    assert game.flags(1) == [1, 1, 1, 0, 0]
    game.check_values(1, 3)  # of another seed, so of another actor
    game.end(0, 3)
    assert game.flags(0) == [1, 0, 1, 1, 0]
    game.end(0, 4)
    assert game.length.tolist() == [3, -7, 5, -7, 4, -7]
    assert game.broken.tolist() == [0, -7, 1, -7, 0, -7]
    assert game.simulated.tolist() == [8, 4]
    assert game.column(PLACES.counted).tolist() == [[7, 5]]


def test_the_actor_of_the_same_seed_stays(game):
    game.call("begin", 0)
    actor = game.column(PLACES.actor_fields[0], 0)
    actor[:] = 77
    game.end(0, 1)
    assert (game.flags(0)[2:4], actor.tolist()) == ([0, 2], [77] * 3)
    game.end(0, 1)
    game.check_values(0, 3)


def test_a_lane_that_waits_counts_for_its_last_seed(game):
    game.call("begin", 0)
    for steps in (1, 2, 3, 4, 5):
        game.end(0, steps)
    assert game.flags(0)[:3] == [0, 0, 1]
    game.check_values(0, 5)
    assert game.simulated.tolist() == [3, 12]
    game.call("settle", 0, 100)
    game.call("settle", 1, 100)  # which has played nothing
    assert game.simulated.tolist() == [3, 12 + 85]


def test_a_lane_without_an_episode_has_the_values_of_the_first(functions):
    game = Game(functions, [SKIP] * 6)
    game.call("begin", 1)
    assert game.flags(1) == [0, 0, 0, 0, 0]
    game.check_values(1, 0)
    assert not game.column(PLACES.state_fields[0], 0).any()


def test_where_there_are_no_episodes_nothing_is_read(functions):
    game = Game(functions, [])
    game.call("begin", 0)
    assert game.flags(0) == [0, 0, -1, 0, 0]
