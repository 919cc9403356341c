"""Places in the frames of links, and rotations, by MuJoCo's functions."""

from typing import Any, NamedTuple

import mujoco
import numpy as np

_C: Any = mujoco  # a C extension without stubs


class Frame(NamedTuple):
    """A place in the frame of a link.

    link: -1 is the world, -2 the first mocap body, -3 the second one
    pos: [3] (m)
    quat: [4]
    """

    link: int
    pos: np.ndarray
    quat: np.ndarray

    def place(self, pos: Any) -> np.ndarray:
        """Returns a point [3] of this frame in the link's."""
        return self.pos + rotation(self.quat) @ np.asarray(pos)

    def then(self, pos: Any, quat: Any) -> "Frame":
        """Returns a frame that has this pose in this one."""
        return Frame(self.link, self.place(pos), times(self.quat, quat))


class Inertial(NamedTuple):
    """A body's center of mass [3] (m) and inertia [3, 3] about it, in the frame of its link."""

    com: np.ndarray
    inertia: np.ndarray


def times(a: Any, b: Any) -> np.ndarray:
    """Returns the product of two quaternions [4]."""
    product = np.zeros(4)
    _C.mju_mulQuat(product, np.asarray(a, float), np.asarray(b, float))
    return product


def rotation(quat: Any) -> np.ndarray:
    """Returns the rotation matrix [3, 3] of a quaternion."""
    matrix = np.zeros(9)
    _C.mju_quat2Mat(matrix, np.asarray(quat, float))
    return matrix.reshape(3, 3)


def six(matrix: np.ndarray) -> list[float]:
    """Returns a symmetric matrix [3, 3] as xx, yy, zz, xy, xz, yz."""
    return [matrix[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
