"""Which nodes the results need, scope by scope."""

import dataclasses
from collections import defaultdict
from collections.abc import Iterable
from typing import Any

from mjx_reinforce.fused.branches import Gate
from mjx_reinforce.fused.graph import Node, Scalar, Scope
from mjx_reinforce.fused.loops import Loop


@dataclasses.dataclass(frozen=True)
class Schedule:
    """What is to be computed.

    Attributes:
        steps: for each scope, its nodes, loops and gates in order.
        carries: for each loop, the positions of its carry that are needed.
        elements: for each loop, the positions of its xs that are needed.
        ys: for each loop, the positions of its ys that are needed.
        wanted: every node that is needed.
    """

    steps: dict[Scope, list[Any]]
    carries: dict[Loop, list[int]]
    elements: dict[Loop, list[int]]
    ys: dict[Loop, list[int]]
    wanted: set[Node]


def schedule(results: Iterable[Scalar]) -> Schedule:
    """Returns what these scalars need, directly or through loops and gates."""
    steps: dict[Scope, set] = defaultdict(set)
    roles: dict[str, dict[Any, set]] = {
        name: defaultdict(set) for name in ("carry", "element", "y")
    }
    waiting, seen = list(results), set()
    while waiting:
        node = waiting.pop()
        if not isinstance(node, Node) or node in seen:
            continue
        seen.add(node)
        if node.op is not None:
            steps[node.scope].add(node)
            waiting.extend(node.args)
        elif isinstance(node.owner, Gate):
            gate = node.owner
            steps[gate.scope].add(gate)
            waiting.extend([gate.predicate, gate.hot[node.position], gate.cold[node.position]])
        elif isinstance(node.owner, Loop):
            steps[node.owner.scope].add(node.owner)
            waiting.extend(_loop_needs(node.owner, node.position, roles))
    return Schedule(
        wanted=seen,
        steps={scope: sorted(nodes, key=lambda n: n.index) for scope, nodes in steps.items()},
        **{
            field: {loop: sorted(places) for loop, places in roles[role].items()}
            for field, role in (("carries", "carry"), ("elements", "element"), ("ys", "y"))
        },
    )


def _loop_needs(loop: Loop, position: tuple, roles: dict) -> list[Scalar]:
    """Notes that a leaf of a loop is needed; returns what it needs in turn."""
    role, i = position[:2]
    needs: list[Scalar] = []
    if role == "element":
        roles["element"][loop].add(i)
        needs += loop.xs[i]
    elif role == "y":
        roles["y"][loop].add(i)
        needs.append(loop.ys[i])
    else:
        roles["carry"][loop].add(i)
        needs += [loop.inits[i], loop.nexts[i]]
    if loop.active is not None and loop.carries[loop.active] is not None:
        needs.append(loop.carries[loop.active])
    return needs
