"""Contacts of two geoms in many poses, ours beside C MuJoCo's.

Poses are crossed from how large the geoms are, how they are turned, and where the second is: apart,
touching at faces, edges and corners, one longer than, inside, or across the other, coaxial,
parallel and nearly so. Compared are the number of contacts nearer than the margin, and the
distance, place and frame of each. Where C's own contacts change when it moves the second geom by
rounding or by 1e-11, nothing is compared: such poses are counted as undecided.
"""

import csv
import dataclasses
import functools
import importlib
import itertools
import sys
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from experiments.checks.mechanisms import ASSETS
from mjx_reinforce.engine.physics import contacts
from mjx_reinforce.engine.physics.mjx_internals import jax_fields
from mjx_reinforce.envs import models

mujoco: Any = importlib.import_module("mujoco")  # pyright does not know what is in it

#: What counts as equal.
EQUAL = 1e-9
#: By how much C moves the second geom to see whether its answer is decided (m and rad): by what is
#: nothing to a user, and by rounding.
_MOVED = (1e-11, 2e-16)
MARGINS = (0.0, 0.02)
_SCENE = """
<mujoco>
  <option ccd_tolerance="1e-12" ccd_iterations="200"/>
  {assets}
  <worldbody>
    <geom name="first" {first}/>
    <body><freejoint/><geom name="second" {second}/></body>
  </worldbody>
  <contact><pair geom1="first" geom2="second" margin="{margin}"/></contact>
</mujoco>"""
#: Geoms with sizes of their own; those of others are drawn.
_FIXED = {"mesh": 'mesh="m"', "hfield": 'hfield="h"'}
TYPES = ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")
#: Half lengths of two geoms in meters: along x and y (radii), and along z.
_SIZES = {
    "alike": ((0.1, 0.12, 0.14), (0.13, 0.11, 0.12)),
    "longer": ((0.02, 0.03, 0.9), (0.2, 0.15, 0.1)),
    "flatter": ((0.12, 0.2, 0.01), (0.5, 0.4, 0.02)),
    "tiny": ((0.004, 0.003, 0.005), (0.9, 1.1, 1.3)),
    "huge": ((1.5, 1.2, 0.9), (0.03, 0.02, 0.05)),
}
_TURNS = ("any", "aligned", "nearly aligned", "about an axis")
_PLACES = ("touching", "beside", "coaxial", "deep", "inside", "concentric", "near", "apart")


class Pose(NamedTuple):
    """Two geoms: sizes [2, 3], places [2, 3] and rotation matrices [2, 3, 3]."""

    size: np.ndarray
    pos: np.ndarray
    mat: np.ndarray


class Outcome(NamedTuple):
    """What became of a pose.

    family: what the pose is an example of
    pose: the pose
    error: the largest error, infinite where the numbers of contacts differ
    decided: whether C's answer stands when it moves the second geom by 1e-11
    touches: whether there are contacts
    """

    family: str
    pose: Pose
    error: float
    decided: bool
    touches: bool


@dataclasses.dataclass(frozen=True)
class Settings:
    """Collide two geoms in many poses, and compare with C MuJoCo."""

    pairs: tuple[str, ...] = ()
    """Pairs such as capsule-box, by default all that the product accepts."""
    poses: int = 4
    """Poses of each family of each pair; there are 160 families."""
    seed: int = 0
    """What poses are drawn from."""
    show: int = 0
    """So many differing poses of each pair are printed, as rows of a CSV file."""


class TwoGeoms:
    """Two geoms of given types, collided by us and by C."""

    def __init__(self, first: str, second: str, margin: float = 0.0):
        """Compiles them; raises ValueError if the product refuses them."""
        self.kinds = (first, second)
        geoms = (f'type="{x}" size=".1 .1 .1" {_FIXED.get(x, "")}' for x in self.kinds)
        below, above = (x.replace('size=".1 .1 .1"', "") if "field" in x else x for x in geoms)
        text = _SCENE.format(first=below, second=above, margin=margin, assets=ASSETS)
        self.model = mujoco.MjModel.from_xml_string(text)
        self.data, self.margin = mujoco.MjData(self.model), margin
        mujoco.mj_forward(self.model, self.data)

    def by_c(self, pose: Pose) -> np.ndarray:
        """Returns C's contacts, [K, 13]: distance, place and frame of each."""
        model, data = self.model, self.data
        for i, kind in enumerate(self.kinds):
            if kind not in _FIXED:
                model.geom_size[i] = pose.size[i]
                model.geom_rbound[i] = _bound(kind, pose.size[i])
        data.geom_xpos[:], data.geom_xmat[:] = pose.pos, pose.mat.reshape(2, 9)
        mujoco.mj_collision(model, data)
        contact = data.contact
        shown = np.hstack([contact.dist[:, None], contact.pos, contact.frame])
        return shown[contact.dist < self.margin]

    @functools.cached_property
    def _collide(self) -> Any:
        model = models.to_mjx(self.model, "the pair")
        start = models.make_data(self.model)

        def collide(size: Any, pos: Any, mat: Any) -> jax.Array:
            data = contacts.collision(
                model.replace(geom_size=size), start.replace(geom_xpos=pos, geom_xmat=mat)
            )
            contact = jax_fields(data).contact
            frame = contact.frame.reshape(-1, 9)
            return jnp.concatenate([contact.dist[:, None], contact.pos, frame], axis=1)

        return jax.jit(jax.vmap(collide))

    def by_us(self, poses: list[Pose]) -> list[np.ndarray]:
        """Returns our contacts of each pose, [K, 13]; raises ValueError if they are refused."""
        return [x[x[:, 0] < self.margin] for x in self.slots(poses)]

    def slots(self, poses: list[Pose]) -> np.ndarray:
        """Returns the contacts of each pose, [poses, N, 13], those that are none included."""
        return np.asarray(self._collide(*map(np.stack, zip(*poses, strict=True))))


def _bound(kind: str, size: np.ndarray) -> float:
    """Returns the radius of a geom's bounding sphere, 0 for a plane."""
    x, y, _ = size
    sphere, capsule, cylinder = x, x + y, np.hypot(x, y)
    bounds = {"sphere": sphere, "capsule": capsule, "cylinder": cylinder, "plane": 0}
    bounds |= {"ellipsoid": max(size), "box": np.linalg.norm(size)}
    return float(bounds[kind])


def error(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Returns the largest difference of contacts [K, 13] in any order, or infinity."""
    if len(ours) != len(theirs):
        return np.inf
    rest, worst = list(ours), 0.0
    for row in theirs:
        differences = [float(np.abs(x - row).max()) for x in rest]
        best = int(np.argmin(differences))
        worst = max(worst, differences[best])
        rest.pop(best)
    return worst if np.isfinite(worst) else np.inf


def moved(pose: Pose, rng: np.random.Generator) -> Iterator[Pose]:
    """Yields poses in which the second geom is moved and turned a little, each way."""
    for by, sign in itertools.product(_MOVED, (1, -1)):
        place, turn = sign * by * rng.normal(size=(2, 3))
        pos, mat = pose.pos.copy(), pose.mat.copy()
        pos[1] += place
        mat[1] = Rotation.from_rotvec(turn).as_matrix() @ mat[1]
        yield Pose(pose.size, pos, mat)


def _turned(turn: str, rng: np.random.Generator) -> Rotation:
    """Returns how the second geom is turned against the first."""
    right = Rotation.create_group("O")[int(rng.integers(24))]
    if turn == "any":
        return Rotation.from_quat(rng.normal(size=4))
    if turn == "about an axis":
        axis = np.eye(3)[rng.integers(3)]
        return Rotation.from_rotvec(rng.uniform(-np.pi, np.pi) * axis) * right
    angle = 10.0 ** rng.uniform(-6, -1.5) if turn == "nearly aligned" else 0.0
    return Rotation.from_rotvec(angle * rng.normal(size=3)) * right


def _size(kind: str, half: Any) -> np.ndarray:
    """Returns MuJoCo's sizes of a geom with these half lengths."""
    x, y, z = half
    if kind in ("capsule", "cylinder"):
        return np.array([x, z, 0])
    return np.array([x, 0, 0]) if kind == "sphere" else np.array([x, y, z])


def draw(
    geoms: TwoGeoms,
    family: tuple[str, str, str],
    rng: np.random.Generator,
    sized: np.ndarray | None = None,
) -> Pose:
    """Returns a pose of a family: of how large the geoms are, how turned, and where.

    Args:
      geoms: the geoms.
      family: the names of their sizes, of how they are turned, and of where they are.
      rng: what is drawn from.
      sized: MuJoCo's sizes [2, 3] in place of drawn ones.
    """
    sizes, turn, place = family
    halves = np.array(_SIZES[sizes]) * rng.uniform(0.9, 1.1, (2, 3))
    halves = halves[:: rng.choice([1, -1])]
    size = np.stack([_size(*x) for x in zip(geoms.kinds, halves, strict=True)])
    size = size if sized is None else sized
    axis = np.eye(3)[rng.integers(3)] * rng.choice([-1, 1])
    direction = axis if place in ("beside", "coaxial") else rng.normal(size=3)
    endless = geoms.kinds[0] in ("plane", "hfield")
    direction = np.eye(3)[2] if endless else direction / np.linalg.norm(direction)
    room = halves.min(axis=0)
    aside = {"coaxial": 0, "concentric": 0, "inside": 0.6}.get(place, 1.0)
    at = aside * rng.uniform(-1, 1, 3) * (room if place == "inside" else halves.max(axis=0))
    whole = Rotation.identity() if rng.random() < 0.3 else Rotation.from_quat(rng.normal(size=4))
    mats = np.stack([whole.as_matrix(), (whole * _turned(turn, rng)).as_matrix()])
    mats = np.where(np.abs(mats - mats.round()) < 1e-15, mats.round(), mats)

    def placed(along: float) -> Pose:
        own = (at - direction * (at @ direction)) * (place != "inside") + at * (place == "inside")
        pos = np.stack([np.zeros(3), whole.apply(own + along * direction)])
        return Pose(size, pos + 0.3, mats)

    if place in ("inside", "concentric"):
        return placed(0.0)
    low, high = 0.0, 2 * float(halves.sum()) + 1
    while high - low > 1e-7:
        middle = (low + high) / 2
        touches = (geoms.by_c(placed(middle))[:, 0] < 0).any()
        low, high = (middle, high) if touches else (low, middle)
    depth = float(room.min()) * rng.uniform(0.02, 0.1)
    gap = {"deep": -low * rng.uniform(0.1, 0.9), "apart": 0.05, "near": 0.4 * depth}
    return placed(low + gap.get(place, -depth))


FAMILIES = tuple(itertools.product(_SIZES, _TURNS, _PLACES))


def outcomes(geoms: TwoGeoms, number: int, seed: int) -> Iterator[Outcome]:
    """Yields what became of so many poses of each family."""
    rng = np.random.default_rng(seed)
    families = [family for family in FAMILIES for _ in range(number)]
    poses = [draw(geoms, family, rng) for family in families]
    found = geoms.by_us(poses)
    for family, pose, ours in zip(families, poses, found, strict=True):
        theirs = geoms.by_c(pose)
        wrong = error(ours, theirs)
        again = [geoms.by_c(x) for _ in range(3) for x in moved(pose, rng)]
        decided = all(error(x, theirs) < EQUAL for x in again)
        yield Outcome(", ".join(family), pose, wrong, decided, bool(len(theirs)))


def accepted_pairs() -> Iterator[tuple[str, str]]:
    """Yields the pairs of types of geoms that MJX collides and the product accepts."""
    for first, second in itertools.combinations_with_replacement(TYPES, 2):
        if second not in ("plane", "hfield"):
            try:
                models.to_mjx(TwoGeoms(first, second).model, "the pair")
            except ValueError:
                continue
            yield first, second


def main(settings: Settings) -> None:
    """Prints for each pair and margin how many poses differ, and the worst."""
    jax.config.update("jax_enable_x64", True)
    pairs = [tuple(x.split("-")) for x in settings.pairs] or list(accepted_pairs())
    for (first, second), margin in itertools.product(pairs, MARGINS):
        geoms = TwoGeoms(first, second, margin)
        name = f"{second} on {first}, margin {margin:g}"
        try:
            results = list(outcomes(geoms, settings.poses, settings.seed))
        except ValueError as refusal:
            print(f"{name}: refused: {refusal}", flush=True)
            continue
        decided = [x for x in results if x.decided]
        wrong = sorted((x for x in decided if x.error > EQUAL), key=lambda x: -x.error)
        finite = [x.error for x in decided if np.isfinite(x.error)]
        print(
            f"{name}: {len(results)} poses, {sum(x.touches for x in results)} touch, "
            f"{len(results) - len(decided)} undecided, {len(wrong)} differ, "
            f"{sum(np.isinf(x.error) for x in wrong)} of them in number; "
            f"worst of the others {max(finite, default=0):.0e}",
            flush=True,
        )
        for each in wrong[: settings.show]:
            row = [first, second, margin, f"{each.error:.0e}", each.family]
            numbers = np.concatenate([np.ravel(x) for x in each.pose])
            csv.writer(sys.stdout, lineterminator="\n").writerow(
                [*row, *map(repr, numbers.tolist())]
            )


if __name__ == "__main__":
    main(tyro.cli(Settings))
