"""Films of episodes: MuJoCo's pictures of them, side by side, and the GIF that these become."""

import functools
import io
import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mjx_reinforce.engine.vector.pictures import Arrow, Renderer, import_mujoco

if TYPE_CHECKING:
    from mjx_reinforce.engine.base import MjSpec
#: Colors of a .gif, beside the one that is transparent.
_COLORS = 255
#: Pictures, spread over a film, whose colors it has.
SAMPLES = 4


def with_sky(spec: "MjSpec") -> Any:
    """Compiles a model to be drawn, with a sky if it has none: MuJoCo's picture would be black."""
    mujoco = import_mujoco()
    sky = mujoco.mjtTexture.mjTEXTURE_SKYBOX
    if not any(texture.type == sky for texture in spec.textures):
        # The six faces of the sky's cube lie below each other: six times as high as wide.
        spec.add_texture(
            name="mjx_reinforce_sky",
            type=sky,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
            rgb1=(0.30, 0.50, 0.72),  # overhead
            rgb2=(0.86, 0.91, 0.95),  # at the horizon
            width=64,
            height=384,
        )
    with warnings.catch_warnings(action="ignore"):  # what MuJoCo deprecates in a model
        return spec.compile()


#: Frames a second at most: what a film shows, and what GIF viewers play.
MAX_RATE = 30
#: Heights of the strip that the words stand in, and of the words, in heights of the picture.
_STRIP = 1 / 13
_WORDS = 1 / 19
#: The least height of words, in pixels.
_LEAST = 10
_INK = (235, 240, 245)
_PAPER = (28, 38, 48)
#: The colors of a commanded velocity and of the robot's.
_COMMAND_INK = (255, 176, 32)
_ROBOT_INK = (64, 200, 255)
#: The robot's velocity is that over so long (s): from step to step it sways with the gait.
_WINDOW = 0.2
#: The words say so long (s) that the robot was pushed.
_PUSH_SECONDS = 0.5


class Take(NamedTuple):
    """An episode to be filmed.

    label: what is seen
    model: what is drawn, an ``MjModel``
    dt: the duration of an env step (s)
    qpos: [L, nq] generalized positions (m, rad), the start's first
    rewards: [T] of each env step
    terms: [T] each, terms of the reward by name; none where it has fewer than two
    commands: [L, K] what the robot is to do at each of the positions, if that is known. Three
      numbers are a velocity in the robot's frame: forward, sideways (m/s), turning (rad/s)
    pushes: [T] whether an env step began with a push, if that is known
    """

    label: str
    model: Any
    dt: float
    qpos: np.ndarray
    rewards: np.ndarray
    terms: Mapping[str, np.ndarray] = MappingProxyType({})
    commands: np.ndarray | None = None
    pushes: np.ndarray | None = None


class Film(NamedTuple):
    """Pictures that are drawn when they are asked for.

    rate: frames a second
    length: how many frames
    samples: numbers of frames that together show its colors
    draw: number of the frame -> picture [height, width, 3] uint8
    """

    rate: float
    length: int
    samples: Sequence[int]
    draw: Callable[[int], np.ndarray]


def side_by_side(
    takes: Sequence[Take],
    width: int,
    height: int,
    *,
    seconds: float,
    max_rate: float = MAX_RATE,
) -> Film:
    """Returns a film of several takes that begin together; one that ends earlier stands still.

    Args:
      takes: one or more, of any models.
      width: of each take (pixels).
      height: of each take (pixels).
      seconds: length at most (simulated s); it ends with the longest take.
      max_rate: frames a second at most.

    Raises:
      ValueError: there is no take.
    """
    if not takes:
        raise ValueError("a video needs at least one take")
    # A frame every few env steps of the slowest take, so that motion is even: as many as keep
    # within the rate. The small numbers here are rounding, by which a frame more would begin.
    dt = max(take.dt for take in takes)
    interval = dt * max(1, math.ceil(1 / (dt * max_rate) - 1e-9))
    duration = max(min(len(take.qpos) * take.dt, seconds) for take in takes)
    # Drawn frame by frame: all pictures of a long film would not fit into memory.
    renderers = [Renderer(take.model, width, height) for take in takes]

    def draw(frame: int) -> np.ndarray:
        pictures = [
            _picture(take, renderer, frame * interval)
            for take, renderer in zip(takes, renderers, strict=True)
        ]
        return np.concatenate(pictures, axis=1)

    length = max(1, math.ceil(duration / interval - 1e-6))
    samples = [*range(0, length, -(-length // SAMPLES))]
    return Film(1 / interval, length, samples, draw)


def _picture(take: Take, renderer: Renderer, seconds: float) -> np.ndarray:
    """Returns a take's picture at a time (s)."""
    # A take that ended keeps its last position.
    step = min(int(seconds / take.dt + 1e-6), len(take.qpos) - 1)
    arrows, strips = _command_shown(take, step)
    picture = renderer.draw(take.qpos[step], arrows)
    total_reward = np.sum(take.rewards[:step])
    digits = 0 if abs(total_reward) >= 100 else 1
    note = f"return {total_reward:,.{digits}f}   {step * take.dt:4.1f} s"
    first = max(0, step - round(_PUSH_SECONDS / take.dt))
    if take.pushes is not None and take.pushes[first:step].any():
        note = f"pushed   {note}"
    picture = caption(picture, take.label, note)
    for words in strips:
        picture = caption(picture, *words, inks=(_COMMAND_INK, _ROBOT_INK))
    return picture


def _command_shown(take: Take, step: int) -> tuple[list[Arrow], list[tuple[str, str]]]:
    """Returns the arrows of a command and of what the robot does, and the words of a strip."""
    if take.commands is None:
        return [], []
    command = take.commands[step]
    if command.size != 3 or (paths := robot_paths(take)) is None:
        return [], [("command " + ", ".join(map(_short, command)), "")]
    speeds = velocities(take, paths)[step]
    heading = paths[step, 2]
    forward, sideways, turning = map(_short, command)
    words = f"command {forward} m/s, {sideways} m/s, {turning} rad/s"
    arrows = [
        Arrow(_in_world(speeds, heading), _ROBOT_INK),
        Arrow(_in_world(command, heading), _COMMAND_INK),
    ]
    return arrows, [(words, "robot " + ", ".join(map(_short, speeds)))]


def robot_paths(take: Take) -> np.ndarray | None:
    """Returns where a robot is, x and y (m), and its heading (rad), [L, 3] at each position.

    The robot is the body of the first free joint; None without one.
    """
    free = np.flatnonzero(take.model.jnt_type == import_mujoco().mjtJoint.mjJNT_FREE)
    if not free.size:
        return None
    start = take.model.jnt_qposadr[free[0]]
    w, x, y, z = take.qpos[:, start + 3 : start + 7].T
    heading = np.arctan2(2 * (w * z + x * y), w**2 + x**2 - y**2 - z**2)
    return np.column_stack([take.qpos[:, start : start + 2], np.unwrap(heading)])


def velocities(take: Take, paths: np.ndarray) -> np.ndarray:
    """Returns a robot's velocity at each position, [L, 3], as three numbers of a command.

    It is the mean over ``_WINDOW``, or since the start.

    Args:
      take: of the robot.
      paths: of ``robot_paths``.
    """
    steps = np.arange(len(paths))
    before = np.maximum(steps - max(1, round(_WINDOW / take.dt)), 0)
    seconds = take.dt * np.maximum(steps - before, 1)
    x, y, turning = ((paths - paths[before]) / seconds[:, None]).T
    cos, sin = np.cos(paths[:, 2]), np.sin(paths[:, 2])
    return np.column_stack([cos * x + sin * y, cos * y - sin * x, turning])


def _in_world(velocity: np.ndarray, heading: float) -> np.ndarray:
    """Returns the velocity [3] in the world (m/s) of one as a command has it."""
    forward, sideways, _ = velocity
    cos, sin = np.cos(heading), np.sin(heading)
    return np.array([cos * forward - sin * sideways, sin * forward + cos * sideways, 0.0])


def _short(number: float) -> str:
    """Returns a number with one digit behind the point; none is -0.0."""
    return f"{round(float(number), 1) + 0.0:.1f}"


def caption(
    picture: np.ndarray, label: str, note: str, inks: Sequence[tuple[int, ...]] = (_INK, _INK)
) -> np.ndarray:
    """Returns a picture [H, W, 3] uint8 above a strip with a label on the left, a note right.

    The two have colors of their own, ``inks``.
    """
    from PIL import Image, ImageDraw

    height, width = picture.shape[:2]
    strip = max(_LEAST + 2, 2 * round(height * _STRIP / 2))
    font = _font(max(_LEAST, round(height * _WORDS)))
    image = Image.new("RGB", (width, height + strip), _PAPER)
    image.paste(Image.fromarray(picture))
    draw = ImageDraw.Draw(image)
    # With a gap between the two, and the margins at the ends, they would not fit.
    if draw.textlength(label + note, font) > width - 3 * strip // 2:
        font = _font(max(_LEAST, round(height * _WORDS * 0.8)))
    middle = height + strip // 2
    draw.text((strip // 3, middle), label, fill=inks[0], font=font, anchor="lm")
    draw.text((width - strip // 3, middle), note, fill=inks[1], font=font, anchor="rm")
    return np.asarray(image)


@functools.cache
def _font(size: int) -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(size)


def gif(
    frames: Iterable[np.ndarray], rate: float, samples: Sequence[np.ndarray], colors: int = _COLORS
) -> bytes:
    """Returns a .gif with one palette: one for each picture takes 6 ms.

    Args:
      frames: pictures [height, width, 3] uint8.
      rate: frames a second.
      samples: a few of the pictures; the film has the colors that show these best.
      colors: how many.
    """
    from PIL import Image

    # Dithering would differ from frame to frame: it flickers, and does not compress.
    dither = Image.Dither.NONE
    palette = Image.fromarray(np.concatenate(samples)).quantize(colors, dither=dither)
    images = (Image.fromarray(x).quantize(palette=palette, dither=dither) for x in frames)
    file = io.BytesIO()
    # Milliseconds a frame; 0 rounds are rounds without end.
    options = {"duration": 1000 / rate, "loop": 0, "optimize": True}
    next(images).save(file, "GIF", save_all=True, append_images=images, **options)
    return file.getvalue()
