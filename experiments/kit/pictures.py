"""How the pictures of docs/ are saved: small, and the same bytes each time."""

from pathlib import Path
from typing import Literal

from matplotlib.figure import Figure
from PIL import Image


def save_picture(figure: Figure, path: Path, dpi: float | Literal["figure"] = "figure") -> None:
    """Saves a figure as a PNG of at most 256 colors.

    Args:
      figure: what is saved.
      path: the file, which is replaced.
      dpi: pixels an inch; by default the figure's own.
    """
    figure.savefig(path, metadata={"Software": None}, dpi=dpi)
    with Image.open(path) as picture:
        small = picture.convert("RGB").quantize(256)
    small.save(path, optimize=True)
