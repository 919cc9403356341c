"""Tables of sensors of touch."""

import numpy as np

from mjx_reinforce.engine.physics import sensors
from mjx_reinforce.engine.team import last_pass
from mjx_reinforce.engine.team.frames import rotation
from mjx_reinforce.engine.team.supported import CYLINDER, SPHERE
from mjx_reinforce.engine.team.tables.store import Tables


def fill(tables: Tables) -> None:
    """Makes the tables of sensors of touch."""
    model = tables.model
    is_of_forces = np.isin(model.sensor_type, sensors.BODY_TYPES)
    tables.constants["SENSES_FORCES"] = int(is_of_forces.any())
    sites = model.sensor_objid[last_pass.touch_sensors(model)]
    tables.constants["NTOUCH"] = len(sites)
    if not len(sites):
        return
    bodies = model.site_bodyid[sites]
    frames = [
        tables.frames[body].then(model.site_pos[site], model.site_quat[site])
        for site, body in zip(sites, bodies, strict=True)
    ]
    size = model.site_size[sites]
    is_sphere = model.site_type[sites] == SPHERE
    is_cylinder = model.site_type[sites] == CYLINDER
    size[is_sphere] = size[is_sphere, :1]
    size[is_cylinder] = size[is_cylinder][:, [0, 0, 1]]
    tables.ints["touch_body"] = bodies
    tables.ints["touch_link"] = [tables.link_number(frame.link) for frame in frames]
    tables.ints["touch_round"] = [last_pass.ROUND_AXES[x] for x in model.site_type[sites]]
    tables.reals["touch_at"] = [frame.pos for frame in frames]
    tables.reals["touch_turn"] = [rotation(frame.quat) for frame in frames]
    tables.reals["touch_size"] = size
