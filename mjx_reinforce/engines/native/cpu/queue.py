"""How a lane begins and ends an episode: LLVM IR that moves one lane's values.

The episodes of all seeds are numbered, and the job has the next number. ``@begin(job, memory,
lane)`` gives a lane the next episode that is played, if there is one; ``@finish``, of the same
arguments, writes down how a lane's episode ended and then gives it the next. ``@settle(job, memory,
lane, iterations)`` counts the steps that a lane waited for others behind its last episode.
"""

from importlib.resources import files
from string import Template

from mjx_reinforce.engines.native import plays
from mjx_reinforce.engines.native.cpu import handler
from mjx_reinforce.engines.native.cpu.lanes import Field, VectorLayout

#: The buffers of a call: so many arguments of its own, those of the actor and the state, the
#: results, of which so many are records of steps.
NUM_CONTROLS, NUM_RECORDS = 3, 3
_LENGTH, _BROKEN = 3, 4


def queue_text(places: VectorLayout, lanes: int) -> str:
    """Returns ``@begin``, ``@finish`` and ``@settle`` for lanes whose values are at ``places``."""
    actor, state = places.actor_fields, places.state_fields
    first_state = NUM_CONTROLS + len(actor)
    first_result = first_state + len(state)
    values = {name: f"i32 0, i32 {number}" for number, name in enumerate(handler.FIELDS)}
    values |= {
        "lanes": str(lanes),
        "alive_at": _lane("%alive.at", places.alive),
        "seed_at": _lane("%seed.at", places.seed),
        "episode_at": _lane("%episode.at", places.episode),
        "step_at": _lane("%step.at", places.step),
        "limit_at": _lane("%limit.at", places.limit),
        "broken_at": _lane("%broken.at", places.broken),
        "counted_at": _lane("%counted.at", places.counted),
        "deterministic_at": _lane("%mode.lane", places.deterministic),
        "plays_arg": str(handler.PLAYS),
        "not_played": str(plays.NOT_PLAYED),
        "length_data": str(first_result + _LENGTH),
        "broken_data": str(first_result + _BROKEN),
        "simulated_data": str(first_result + handler.SIMULATED),
        "copy_actor": "\n".join(
            _copy(f"actor{i}", field, NUM_CONTROLS + i, "%index") for i, field in enumerate(actor)
        ),
        "copy_state": "\n".join(
            [
                *(_copy(f"state{i}", x, first_state + i, "%item") for i, x in enumerate(state)),
                _copy("keys", places.key, handler.KEYS, "%item"),
            ]
        ),
    }
    template = files("mjx_reinforce.engines.native.cpu").joinpath("queue.ll").read_text("utf-8")
    return Template(template).substitute(values)


def _lane(name: str, field: Field) -> str:
    """Returns the instructions that point to a lane's entry of a field's first vector."""
    return "\n  ".join(
        [
            f"{name}.k = mul i64 %lane, {field.dtype.itemsize}",
            f"{name}.o = add i64 {name}.k, {field.offset}",
            f"{name} = getelementptr inbounds i8, ptr %memory, i64 {name}.o",
        ]
    )


def _copy(name: str, field: Field, buffer: int, row: str) -> str:
    """Returns the instructions that copy a row of a buffer into a lane's column of a field."""
    size = field.dtype.itemsize
    lines = [
        f"%{name}.buffer.at = getelementptr inbounds ptr, ptr %data, i64 {buffer}",
        f"%{name}.buffer = load ptr, ptr %{name}.buffer.at",
        f"%{name}.from.k = mul i64 {row}, {field.count * size}",
        f"%{name}.from = getelementptr inbounds i8, ptr %{name}.buffer, i64 %{name}.from.k",
        _lane(f"%{name}.to", field),
        f"call void @copy{size}(ptr %{name}.to, ptr %{name}.from, i64 {field.count})",
    ]
    return "\n".join(f"  {line}" for line in lines)
