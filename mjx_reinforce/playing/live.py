"""A trained policy live in MuJoCo's viewer."""

import itertools
import time
from typing import TYPE_CHECKING, Any

from mjx_reinforce.envs.in_mujoco import InMujoco
from mjx_reinforce.export.player import Player
from mjx_reinforce.playing.mujoco_playing import simulate

if TYPE_CHECKING:
    from mjx_reinforce.envs.base import MujocoEnv
    from mjx_reinforce.types import MjModel


def live(env: "MujocoEnv", model: "MjModel", player: Player, horizon: int, settings: Any) -> None:
    """Plays episode after episode in MuJoCo's viewer, at the speed of life, until it is closed.

    The mouse pulls at bodies: a double click selects one, Ctrl and a drag pulls.

    Args:
      env: a task of ``MujocoEnv``.
      model: what is drawn, with the bodies of the task's own model.
      player: the policy.
      horizon: the time limit in steps.
      settings: ``episode``, ``noise`` and ``push``, as in ``watch.WatchSettings``.

    Raises:
      ValueError: the viewer does not open, or C MuJoCo cannot play the task.
    """
    import mujoco.viewer

    kinds: Any = mujoco
    simulation, drawn = InMujoco(env), kinds.MjData(model)
    try:
        window = mujoco.viewer.launch_passive(model, drawn, show_left_ui=False, show_right_ui=False)
    except Exception as error:  # of GLFW, or on macOS, where it wants mjpython
        raise ValueError(
            f"MuJoCo's viewer does not open ({error}); on macOS, start with mjpython in place of "
            "python; leave --live out to write a film"
        ) from error
    with window:
        for episode in itertools.count(settings.episode):
            total, due = 0.0, time.monotonic()
            steps = simulate(simulation, player, episode, settings.noise, settings.push)
            for moment in itertools.islice(steps, 1 + horizon):
                if not window.is_running():
                    return
                total += moment.reward if moment is not None else 0.0
                drawn.qpos[:] = simulation.data.qpos
                kinds.mj_forward(model, drawn)
                drawn.xfrc_applied[:] = 0
                kinds.mjv_applyPerturbForce(model, drawn, window.perturb)
                simulation.data.xfrc_applied[:] = drawn.xfrc_applied
                window.sync()
                due += env.dt
                time.sleep(max(0.0, due - time.monotonic()))
            print(f"episode {episode}: return {total:.1f}", flush=True)
