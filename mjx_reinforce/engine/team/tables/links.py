"""Tables of links, which joints move, and of how their poses are joined to those of the world."""

import numpy as np

from mjx_reinforce.engine.team import records
from mjx_reinforce.engine.team.frames import Frame, rotation, times
from mjx_reinforce.engine.team.supported import BALL, FREE, HINGE, SLIDE
from mjx_reinforce.engine.team.tables.store import Tables


def fill(tables: Tables) -> None:
    """Makes the tables of links, and finds the frames of bodies."""
    model = tables.model
    identity = np.eye(4)[0]
    tables.frames.append(Frame(-1, np.zeros(3), identity))
    rows = []
    for body in range(1, model.nbody):
        parent = tables.frames[model.body_parentid[body]]
        frame = parent.then(model.body_pos[body], model.body_quat[body])
        if model.body_mocapid[body] >= 0:
            frame = Frame(-2 - model.body_mocapid[body], np.zeros(3), identity)
        start = model.body_jntadr[body]
        # The joints of a body are a chain: each moves the frame of the next.
        for joint in range(start, start + model.body_jntnum[body]):
            kind = model.jnt_type[joint]
            axis = model.jnt_axis[joint]
            anchor = model.jnt_pos[joint]
            parent_link = frame.link
            if kind == FREE:  # qpos has its place in the world
                anchor = np.zeros(3)
                parent_link = -1
            # The pose is linear in these two: for a hinge at angle q, the quaternion is
            # cos(q/2) quat + sin(q/2) turned; for a slide, the place is at + q turned.
            axis_quat = times(frame.quat, [0, *axis])
            if kind == SLIDE:
                axis_quat = [*(rotation(frame.quat) @ axis), 0]
            zero_qpos = 0
            if kind in (HINGE, SLIDE):
                zero_qpos = model.qpos0[model.jnt_qposadr[joint]]
            rows.append((frame.place(anchor), frame.quat, axis_quat, zero_qpos))
            tables.parents.append(parent_link)
            frame = Frame(joint, -np.asarray(anchor), identity)
        tables.frames.append(frame)
    joint_kinds = model.jnt_type
    columns = ("link_at", "link_quat", "link_turned", "link_zero")
    tables.reals |= zip(columns, zip(*rows, strict=True), strict=True)
    tables.ints["link_kind"] = joint_kinds
    tables.ints["link_qpos"] = model.jnt_qposadr
    tables.ints["link_dof"] = model.jnt_dofadr
    tables.functions["link_parent"] = tables.parents
    tables.functions["has_children"] = [int(x in tables.parents) for x in range(model.njnt)]
    joints = np.flatnonzero(joint_kinds <= BALL)
    tables.ints["turn_dof"] = model.jnt_dofadr[joints] + 3 * (joint_kinds[joints] == FREE)
    tables.constants["NTURN"] = len(joints)
    # Where an episode does not say otherwise.
    mocap_bodies = np.flatnonzero(model.body_mocapid >= 0)
    tables.constants["NMOCAP"] = model.nmocap
    tables.reals["mocap_pos"] = model.body_pos[mocap_bodies]
    tables.reals["mocap_quat"] = model.body_quat[mocap_bodies]


def fill_jumps(tables: Tables) -> None:
    """Makes the table by which poses of links are joined to those of the world."""
    # After a round, a link's pose is in the frame of an ancestor twice as far up as before:
    # log2(depth) rounds, where going down the tree takes as many as the tree is deep.
    ancestors = list(tables.parents)
    jumps = []
    starts = [0]
    while any(x != -1 for x in ancestors):
        for row in range(3):
            jumps += [
                records.packed(3 * link + row, 3 * tables.link_number(ancestor) + row)
                for link, ancestor in enumerate(ancestors)
                if ancestor != -1
            ]
        starts.append(len(jumps))
        ancestors = [ancestors[x] if x >= 0 else -1 for x in ancestors]
    tables.ints["jump"] = jumps
    tables.functions["jump_start"] = starts
    tables.constants["ROUNDS"] = len(starts) - 1
