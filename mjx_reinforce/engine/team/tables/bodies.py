"""Tables of bodies, and of the inertias of links."""

import numpy as np

from mjx_reinforce.engine.team.contact_kinds import MIN_VALUE
from mjx_reinforce.engine.team.frames import Inertial, rotation, six
from mjx_reinforce.engine.team.tables.store import Tables


def fill(tables: Tables) -> None:
    """Makes the tables of bodies, and of the inertias of links."""
    model = tables.model
    bodies = []
    for body in range(model.nbody):
        frame = tables.frames[body].then(model.body_ipos[body], model.body_iquat[body])
        turn = rotation(frame.quat)
        bodies.append(Inertial(frame.pos, turn @ np.diag(model.body_inertia[body]) @ turn.T))
    tables.ints["body_link"] = [tables.link_number(x.link) for x in tables.frames]
    tables.ints["body_root"] = model.body_rootid
    tables.reals["body_at"] = [x.pos for x in tables.frames]
    tables.reals["body_com"] = [x.com for x in bodies]
    tables.reals["body_inertia"] = [six(x.inertia) for x in bodies]
    tables.reals["body_mass"] = model.body_mass
    masses = []
    links = []
    for link in range(model.njnt):
        link_bodies = [x for x in range(model.nbody) if tables.frames[x].link == link]
        mass = sum(model.body_mass[x] for x in link_bodies)
        # A link may carry nothing: that of the first of two hinges of one body.
        com = np.zeros(3)
        if link_bodies and mass != 0:
            mass_moments = (model.body_mass[x] * bodies[x].com for x in link_bodies)
            com = sum(mass_moments, start=np.zeros(3)) / max(mass, MIN_VALUE)
        inertia = np.zeros((3, 3))
        for x in link_bodies:  # the parallel axis theorem
            arm = bodies[x].com - com
            shift = arm @ arm * np.eye(3) - np.outer(arm, arm)
            inertia += bodies[x].inertia + model.body_mass[x] * shift
        masses.append(mass)
        links.append(Inertial(com, inertia))
    tables.reals["link_mass"] = masses
    tables.reals["link_com"] = [x.com for x in links]
    tables.reals["link_inertia"] = [six(x.inertia) for x in links]
