"""Tables of the pairs of geoms that may meet, and of what their contacts have in common."""

from collections.abc import Iterable

import numpy as np

from mjx_reinforce.engine.team import contact_kinds, flags, records, supported
from mjx_reinforce.engine.team.contact_kinds import MIN_VALUE, ContactKind, contact_kind
from mjx_reinforce.engine.team.tables import draws, geoms
from mjx_reinforce.engine.team.tables.solver import is_elliptic
from mjx_reinforce.engine.team.tables.store import Tables


def fill(tables: Tables, num_near: int) -> None:
    """Makes the tables of geoms that may meet."""
    model = tables.model
    pairs = [(pair, contact_kind(model, pair)) for pair in supported.meeting(model)]
    numbers = sorted({geom for pair, _ in pairs for geom in (pair.geom1, pair.geom2)})
    geom_ids = {geom: number for number, geom in enumerate(numbers)}
    # Contacts whose friction an episode draws also have in common which geom's it is.
    has_friction = "geom_friction" in tables.random
    kind_numbers: dict[tuple[ContactKind, int], int] = {}
    kind_pairs = 0
    num_contacts = 0
    # Where parts are many, their table leaves little shared memory, and going through it takes
    # long.
    is_whole = supported.num_parts(model) > supported.MAX_ITEMS
    items = []
    item_kinds = []
    weights = []
    for pair, kind in pairs:
        mix = contact_kinds.mix_of(model, pair) if has_friction else contact_kinds.Mix.LARGER
        number = kind_numbers.setdefault((kind, mix), len(kind_numbers))
        bodies = model.geom_bodyid[[pair.geom1, pair.geom2]]
        weight = sum(model.body_invweight0[body, 0] for body in bodies)
        if kind.dim > 1 and not is_elliptic(model):
            # Of an edge of the pyramid, which pushes along a tangent, too.
            friction = kind.friction[0]
            weight *= 2 * friction**2 / model.opt.impratio * (1 + friction**2)
        geom_types = supported.geom_kinds(model, pair)
        flat, other = (geoms.KINDS[x] for x in geom_types)
        kind_pairs |= 1 << (other * (other + 1) // 2 + flat)
        # The convex collider finds all contacts of a pair at once.
        num_parts = supported.NUM_PARTS.get(geom_types, 1)
        num_contacts += supported.CONVEX_CONTACTS.get(geom_types, num_parts)
        for part in [num_parts - 1] if is_whole else range(num_parts):
            items.append(records.packed_item(geom_ids[pair.geom1], geom_ids[pair.geom2], part))
            item_kinds.append(number)
            weights.append(weight)
    tables.ints["item"] = items
    tables.ints["item_kind"] = item_kinds
    has_weights = has_friction or bool(draws.INERTIAL.intersection(tables.random))
    tables.constants["DRAWS_FRICTION"] = int(has_friction)
    tables.constants["DRAWS_WEIGHTS"] = int(has_weights)
    tables.real_constants["CONE_SCALE"] = float(max(model.opt.impratio, MIN_VALUE) ** -0.5)
    tables.reals["item_weight"] = [] if has_weights else weights
    tables.reals["body_weight"] = model.body_invweight0[:, 0] if has_weights else []
    tables.reals["geom_friction"] = model.geom_friction[numbers] if has_friction else []
    tables.ints["kind_mix"] = [mix for _, mix in kind_numbers] if has_friction else []
    tables.geoms = np.array(numbers, int)
    kinds = [kind for kind, _ in kind_numbers]
    _fill_kinds(tables, kinds)
    tables.constants["KIND_PAIRS"] = kind_pairs
    tables.constants["NI"] = len(items)
    tables.constants["WHOLE_PAIRS"] = int(is_whole)
    tables.constants["NC"] = num_contacts
    tables.constants["NEAR"] = max(1, min(num_near, num_contacts))
    _fill_convex(tables, [pair for pair, _ in pairs], kinds)
    tables.constants["CD"] = max((x.dim for x in kinds), default=1)
    tables.constants["NG"] = max(len(numbers), 1)
    geoms.fill(tables)


def _fill_kinds(tables: Tables, kinds: list[ContactKind]) -> None:
    """Makes the tables of what contacts of several pairs have in common."""
    tables.ints["kind_dim"] = [x.dim for x in kinds]
    tables.ints["kind_soft"] = [tables.number(x.softness) for x in kinds]
    tables.reals["kind_margin"] = [x.margin for x in kinds]
    tables.reals["kind_friction"] = [x.friction for x in kinds]
    # C's regularized friction of the cone.
    cone_kinds = kinds if is_elliptic(tables.model) else []
    root = np.sqrt(max(tables.model.opt.impratio, MIN_VALUE))
    tables.reals["kind_mu"] = [x.friction[0] / root for x in cone_kinds]
    tables.ints["kind_soft_friction"] = [tables.number(x.friction_softness) for x in cone_kinds]


def _fill_convex(
    tables: Tables, pairs: Iterable[supported.GeomPair], kinds: Iterable[ContactKind]
) -> None:
    """Makes the tables of the convex collider."""
    model = tables.model
    all_types = [supported.geom_kinds(model, x) for x in pairs]
    convex_types = [x for x in all_types if x in supported.CONVEX_CONTACTS]
    num_contacts = [supported.CONVEX_CONTACTS[x] for x in convex_types]
    geom_kinds = {geoms.KINDS[x] for types in convex_types for x in types}
    tables.constants["CONVEX_KINDS"] = sum(1 << x for x in geom_kinds)
    tables.constants["CONVEX_CONTACTS"] = max(num_contacts, default=0)
    tables.constants["MORE_CONTACTS"] = not flags.is_off(model, "multiccd")
    tables.constants["CONVEX_STEPS"] = model.opt.ccd_iterations
    tables.real_constants["CONVEX_TOLERANCE"] = float(model.opt.ccd_tolerance)
    tables.reals["kind_gap"] = [x.gap for x in kinds] if convex_types else []
