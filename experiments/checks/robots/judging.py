"""Judges one model in a process of its own, with limits of time and memory."""

import contextlib
import multiprocessing
import os
import re
import resource
import signal
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax

from experiments.checks.robots import models, playing
from experiments.kit.places import ROOT

_MAX_WORDS = 160


class Question(NamedTuple):
    """What is asked about models.

    phase: "equality" or "speed"
    engine: whose equality is judged
    seconds, gigabytes: what a model may take
    """

    phase: str
    engine: str
    seconds: float
    gigabytes: float


def judge(question: Question, path: Path, mechanisms: dict[str, str], sender: Any) -> None:
    """Judges one model and sends what is known of its row, each time that there is more.

    Args:
      question: what is asked.
      path: of the model.
      mechanisms: the models that have a row, by the mechanism.
      sender: the end of a pipe.
    """
    isolate(question.gigabytes)
    try:
        model, stubs = models.load(path)
    except ValueError as error:
        sender.send({"verdict": "no model", "cause": words(error, path)})
        return
    mechanism = models.mechanism(model)
    sender.send({"mechanism": mechanism, "actuators": model.nu, "stubs": stubs})
    if question.phase == "equality" and mechanism in mechanisms:
        sender.send({"verdict": "same mechanism", "cause": mechanisms[mechanism]})
        return
    if not model.nu:
        sender.send({"verdict": "no actuators"})
        return
    jax.config.update("jax_enable_x64", question.phase == "equality")
    try:
        if question.phase == "equality":
            row = playing.equality(model, question.engine)
        else:
            row = playing.speed(model)
        row["why"] = words(row.get("why", ""), path)
        sender.send(row)
    except Exception as error:
        # A refusal is an error of this package, in words; another's error is a fault of ours.
        place = traceback.extract_tb(error.__traceback__)[-1]
        folders = Path(place.filename).resolve().parents
        is_ours = ROOT in folders and ROOT / "experiments" not in folders
        is_refusal = isinstance(error, ValueError) and is_ours
        sentence = f"{words(error, path)} ({Path(place.filename).name}:{place.lineno})"
        if is_refusal:
            sender.send({"verdict": "refused", "cause": words(error, path)})
        else:
            sender.send({"verdict": "crashed", "cause": f"{type(error).__name__}: {sentence}"})


def isolate(gigabytes: float) -> None:
    """Limits the memory of this process, and lets it write nothing."""
    limit = int(gigabytes * 2**30)
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    # MuJoCo writes its log into the current folder, and prints its warnings.
    os.chdir(tempfile.gettempdir())
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1)
    os.dup2(silence, 2)
    warnings.simplefilter("ignore")


def words(message: object, path: Path) -> str:
    """Returns the beginning of a message, in one line, without this machine's folders."""
    text = " ".join(str(message).replace(str(path), path.name).split())
    text = re.sub(r"(/[\w.+-]+)+/(?=[\w.+-]+)", "", text)
    return text[:_MAX_WORDS]


def _kill(process: Any) -> None:
    """Kills a process, and the compilers that it has started, which would outlive it."""
    children = [
        int(pid)
        for path in Path(f"/proc/{process.pid}/task").glob("*/children")
        for pid in path.read_text().split()
    ]
    process.kill()
    process.join()
    for pid in children:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def judged(question: Question, path: Path, mechanisms: dict[str, str]) -> dict[str, Any]:
    """Returns what a process of its own finds out about a model."""
    return answers(judge, question, path, mechanisms, seconds=question.seconds)


def answers(function: Callable[..., None], *arguments: Any, seconds: float) -> dict[str, Any]:
    """Returns what a function sends from a process of its own; a verdict if that fails.

    Args:
      function: of the arguments and of the end of a pipe, by which it sends parts of a row.
      *arguments: its arguments but the last.
      seconds: it may take so long.
    """
    # A server has imported everything once, before any thread of JAX's; each model is its child.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([function.__module__])
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=function, args=(*arguments, sender))
    process.start()
    sender.close()
    deadline = time.monotonic() + seconds
    row: dict[str, Any] = {}
    try:
        while receiver.poll(max(0.0, deadline - time.monotonic())):
            row |= receiver.recv()
        _kill(process)
        return row | {"verdict": "too long", "cause": f"over {seconds:g} s"}
    except EOFError:  # the process has ended
        process.join()
        if process.exitcode:
            return row | {"verdict": "crashed", "cause": f"exit status {process.exitcode}"}
        return row
