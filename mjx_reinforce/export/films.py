"""Films of episodes: MuJoCo's renderer, and the files that its pictures become."""

import ctypes.util
import io
import os
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce.export.files import write_bytes


class Renderer:
    """Draws a model at given positions, through its camera "track" if it has one."""

    def __init__(self, model: Any, width: int, height: int):
        """Opens MuJoCo's renderer for pictures of so many pixels.

        Raises:
          ValueError: there is no OpenGL here.
        """
        mujoco = import_mujoco()
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
        model.vis.global_.offheight = max(model.vis.global_.offheight, height)
        model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.4, 0.6
        # Without a GPU a fine shadow takes half the time of a picture, and shows no better in it.
        model.vis.quality.shadowsize = min(model.vis.quality.shadowsize, 2 * max(width, height))
        cameras = [model.camera(i).name for i in range(model.ncam)]
        self._camera = "track" if "track" in cameras else -1
        self._model, self._data = model, mujoco.MjData(model)
        self._forward = mujoco.mj_forward
        try:
            self._renderer = mujoco.Renderer(model, height, width)
        except Exception as error:  # each of MuJoCo's backends has its own
            raise _no_drawing(error) from error

    def draw(self, qpos: np.ndarray) -> np.ndarray:
        """Returns a picture [height, width, 3] uint8 at positions [nq]."""
        self._data.qpos[:] = qpos
        self._forward(self._model, self._data)
        self._renderer.update_scene(self._data, self._camera)
        return self._renderer.render()


def import_gymnasium() -> Any:
    """Returns the module, or raises ValueError with a remedy."""
    try:
        import gymnasium
    except ImportError as error:
        raise ValueError(
            f"--backend gymnasium needs Gymnasium ({error}); pip install 'gymnasium[mujoco]'"
        ) from error
    return gymnasium


def import_mujoco() -> Any:
    """Returns MuJoCo; without a screen it is told to draw through EGL, where that is installed."""
    if not os.environ.get("DISPLAY") and ctypes.util.find_library("EGL"):
        os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        import mujoco
    except Exception as error:  # what MUJOCO_GL names is not here
        raise _no_drawing(error) from error
    return mujoco


def _no_drawing(error: Exception) -> ValueError:
    return ValueError(
        f"MuJoCo cannot draw here ({error}); install EGL (Debian: apt install libegl1) "
        "or set MUJOCO_GL to egl, osmesa or glfw, whichever this machine has"
    )


def write_film(
    path: Path, frames: Iterable[np.ndarray], rate: float, samples: Sequence[np.ndarray]
) -> None:
    """Writes a film at once.

    Args:
      path: .gif or .mp4.
      frames: pictures [height, width, 3] uint8.
      rate: frames a second.
      samples: a few of the pictures; a .gif has the 256 colours that show these best.
    """
    if path.suffix.lower() == ".gif":
        write_bytes(path, _gif(frames, rate, np.concatenate(samples)))
    else:
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            partial = Path(folder) / path.name
            mediapy_with_ffmpeg(path).write_video(partial, list(frames), fps=rate)
            os.replace(partial, path)


def _gif(frames: Iterable[np.ndarray], rate: float, sample: np.ndarray) -> bytes:
    """Returns a .gif with one palette, that of a sample [H, W, 3]: one a picture takes 6 ms."""
    from PIL import Image

    palette = Image.fromarray(sample).quantize(256, dither=Image.Dither.NONE)
    pictures = (
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in frames
    )
    options: dict[str, Any] = {"save_all": True, "loop": 0, "duration": 1000 / rate}
    film = io.BytesIO()
    # To optimise is to look for colours that a picture lacks: it takes four times as long.
    next(pictures).save(film, "GIF", append_images=pictures, optimize=False, **options)
    return film.getvalue()


def mediapy_with_ffmpeg(path: Path) -> Any:
    """Returns mediapy with an ffmpeg.

    Raises:
      ValueError: one of the two is not installed.
    """
    try:
        import imageio_ffmpeg
        import mediapy

        mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError) as error:
        raise ValueError(
            f"cannot write {path} ({error}); "
            "pip install mediapy imageio-ffmpeg, or end --output in .gif"
        ) from error
    return mediapy
