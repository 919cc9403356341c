"""A run whose seeds are shared among processes; process 0 has its state, its files and its screen.

For every block of updates process 0 sends each process the states of its seeds, and gets them back
moved on. So the others keep nothing, and the run goes on from a checkpoint as it does in one
process. All wait for the slowest after each block, as the seeds of one process do.
"""

import io
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.files import Arrays
from mjx_reinforce.hosts.processes import Processes
from mjx_reinforce.policies.actor import Actor
from mjx_reinforce.training.programs import Looked, RunPrograms
from mjx_reinforce.training.state import Budget, RunState, restored
from mjx_reinforce.types import PyTree, plain

#: What a process is asked for, besides the names of ``RunPrograms``.
_END = "end"


def lead(
    processes: Processes, programs: RunPrograms, state: RunState, num_seeds: int
) -> tuple[RunState, RunPrograms]:
    """Returns the state of all seeds, and programs that move it on in all processes.

    Args:
      processes: this is the first of them.
      programs: for its own seeds.
      state: of these.
      num_seeds: S, of all processes.
    """
    like, shares = jax.eval_shape(lambda: state), processes.shares(num_seeds)

    def gathered(mine: Arrays) -> list[Arrays]:
        others = processes.hear()
        assert others is not None, "a process left a run that had not ended"
        return [mine, *(_decode_message(content)[1] for content in others)]

    def ask(name: str, tree: PyTree, **common: np.ndarray) -> list[Arrays]:
        leaves = _numbered_leaves(tree)
        parts = [{k: x[each] for k, x in leaves.items()} | common for each in shares]
        processes.tell(*(_encode_message(name, part) for part in parts[1:]))
        return gathered(_answer(name, parts[0], programs, like))

    def advance(
        before: RunState, look: bool, budget: Budget
    ) -> tuple[RunState, Arrays, Looked | None]:
        limits = np.stack([np.asarray(limit) for limit in budget])
        answers = ask("look and advance" if look else "advance", before, budget=limits)
        states, metrics, looked = (
            [_group_of(x, group) for x in answers] for group in ("state", "metrics", "looked")
        )
        evaluation = _looked(before, _together(looked)) if look else None
        return _state_of(_together(states), like), _together_in_time(metrics), evaluation

    def evaluate(present: RunState) -> Looked:
        return _looked(present, _together(ask("evaluate", present)))

    def test(actor: Actor) -> Arrays:
        return _together(ask("test", actor))

    first = _state_of(_together(gathered(_numbered_leaves(state))), like)
    return first, RunPrograms(advance, evaluate, test)


def end(processes: Processes, status: int) -> None:
    """Tells all others to end with that status."""
    processes.tell(_encode_message(_END, {"status": np.array(status)}))


def serve(processes: Processes, programs: RunPrograms, state: RunState) -> int:
    """Does what process 0 asks for, until the end; returns the status to end with.

    Args:
      processes: this is not the first of them.
      programs: for its own seeds.
      state: of these, before their first update.
    """
    like = jax.eval_shape(lambda: state)
    processes.tell(_encode_message("state", _numbered_leaves(state)))
    while True:
        heard = processes.hear()
        assert heard is not None, "process 0 left a run that had not ended"
        name, given = _decode_message(heard[0])
        if name == _END:
            return int(given["status"])
        processes.tell(_encode_message(name, _answer(name, given, programs, like)))


def _answer(name: str, given: Arrays, programs: RunPrograms, like: RunState) -> Arrays:
    """Returns what a program makes of the leaves that it is given."""
    # In memory of the device's own, which may be donated.
    budget = given.pop("budget", None)
    leaves = [jnp.array(given[str(i)]) for i in range(len(given))]
    if budget is not None:
        before, look = restored(leaves, like), name != "advance"
        state, metrics, looked = programs.advance(before, look, Budget(*budget))
        measured = {} if looked is None else looked.measured
        groups = {"state": _numbered_leaves(state), "metrics": metrics, "looked": measured}
        return {f"{group}/{k}": x for group, arrays in groups.items() for k, x in arrays.items()}
    if name == "evaluate":
        return programs.evaluate(restored(leaves, like)).measured
    return programs.test(jax.tree.unflatten(jax.tree.structure(like.train_states.actor), leaves))


def _looked(state: RunState, measured: Arrays) -> Looked:
    """Returns an evaluation of states on the host."""
    actor, num_updates = jax.device_get((state.train_states.actor, state.train_states.num_updates))
    return Looked(actor, num_updates, measured)


def _state_of(leaves: Arrays, like: RunState) -> RunState:
    """Returns states on the host, from what ``_numbered_leaves`` returned."""
    return restored([leaves[str(i)] for i in range(len(leaves))], like)


def _numbered_leaves(tree: PyTree) -> Arrays:
    """Returns the leaves of a pytree on the host by their numbers; keys as data."""
    leaves = jax.device_get(jax.tree.leaves(plain(tree)))
    return {str(i): np.asarray(leaf) for i, leaf in enumerate(leaves)}


def _group_of(arrays: Arrays, group: str) -> Arrays:
    return {k.removeprefix(f"{group}/"): x for k, x in arrays.items() if k.startswith(f"{group}/")}


def _together(parts: Sequence[Arrays]) -> Arrays:
    """Returns arrays of all seeds, in the first axis."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _together_in_time(parts: Sequence[Arrays]) -> Arrays:
    """Returns the metrics [K, S] of all seeds; those of a process that made fewer stand still."""
    length = max(len(part["active"]) for part in parts)

    def filled(rows: np.ndarray) -> np.ndarray:
        missing = np.zeros((length - len(rows), *rows.shape[1:]), rows.dtype)
        return np.concatenate([rows, missing])

    return {
        name: np.concatenate([filled(part[name]) for part in parts], axis=1) for name in parts[0]
    }


def _encode_message(name: str, arrays: Mapping[str, np.ndarray]) -> bytes:
    """Returns a message: a NumPy archive."""
    archive = io.BytesIO()
    np.savez(archive, allow_pickle=False, name=np.array(name), **arrays)
    return archive.getvalue()


def _decode_message(message: bytes) -> tuple[str, Arrays]:
    """Returns what ``_encode_message`` was given."""
    with np.load(io.BytesIO(message), allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    return str(arrays.pop("name")), arrays
