"""Forces on bodies, and the sensors of forces and accelerations, as in C MuJoCo 4.0.

MJX leaves out the forces of spatial tendons (``tendons``) and the cutoff of a frame's acceleration,
counts the rows of equalities and contacts whose flags are disabled, though nothing has made them,
and fails where a sensor asks for contacts that cannot be.
"""

from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from mjx_reinforce.engine.physics import tendons
from mjx_reinforce.engine.physics.mjx_internals import jax_fields, with_contact, with_fields

_NO_EQUALITY = mjx.DisableBit.EQUALITY | mjx.DisableBit.CONSTRAINT
_NO_CONTACT = mjx.DisableBit.CONTACT | mjx.DisableBit.CONSTRAINT
_CONTACT_TYPES = mjx.SensorType.TOUCH, mjx.SensorType.CONTACT
_FRAME_TYPES = mjx.SensorType.FRAMELINACC, mjx.SensorType.FRAMEANGACC
#: What shows forces on bodies, or what follows from them.
BODY_TYPES = (
    mjx.SensorType.ACCELEROMETER,
    mjx.SensorType.FORCE,
    mjx.SensorType.TORQUE,
    *_FRAME_TYPES,
)
#: A type that no sensor has.
_NO_TYPE = -1
_SENSOR_FIELDS = "cacc", "cfrc_int", "cfrc_ext", "subtree_linvel", "subtree_angmom"
#: What is computed only for sensors.
Readings: TypeAlias = dict[str, Any]


def rne_postconstraint(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Computes cfrc_ext, cfrc_int and cacc, as ``mj_rnePostConstraint``."""
    model, reduced_data = _existing(model, data)
    return _like(mjx.rne_postconstraint(model, with_tendons(model, reduced_data)), data)


def sensor_acc(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Computes the sensors of forces and accelerations, as ``mj_sensorAcc``."""
    model, reduced_data = _existing(model, data)
    # These read ``cacc`` and ``cfrc_int``, for which MJX calls its ``rne_postconstraint``.
    if np.isin(model.sensor_type, BODY_TYPES).any():
        reduced_data = with_tendons(model, reduced_data)
    # MJX fails on sensors of contacts where there can be none; left out, they show zero.
    if not jax_fields(reduced_data).contact.dim.size:
        is_contact = np.isin(model.sensor_type, _CONTACT_TYPES)
        sensor_type = np.where(is_contact, _NO_TYPE, model.sensor_type)
        model = model.replace(sensor_type=sensor_type)
    return _like(_cut(model, mjx.sensor_acc(model, reduced_data)), data)


def _cut(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Returns the data with the accelerations of frames within their cutoffs."""
    has_cutoff = np.isin(model.sensor_type, _FRAME_TYPES) & (model.sensor_cutoff > 0)
    if not has_cutoff.any():
        return data
    # A sensor has ``sensor_dim`` entries one after the other, and one cutoff for all.
    cutoff = np.repeat(np.where(has_cutoff, model.sensor_cutoff, np.inf), model.sensor_dim)
    return data.replace(sensordata=jnp.clip(data.sensordata, -cutoff, cutoff))


def readings(model: mjx.Model, data: mjx.Data) -> Readings:
    """Returns what is computed only for sensors; nothing if the model has none."""
    if not model.nsensor:
        return {}
    fields = {name: getattr(jax_fields(data), name) for name in _SENSOR_FIELDS}
    return {"sensordata": data.sensordata, "fields": fields}


def with_readings(data: mjx.Data, readings: Readings) -> mjx.Data:
    """Returns the data with what ``readings`` returned."""
    if not readings:
        return data
    return with_fields(data.replace(sensordata=readings["sensordata"]), **readings["fields"])


def _like(sensor_data: mjx.Data, data: mjx.Data) -> mjx.Data:
    """Returns what was computed, with the contacts and the forces that the data had."""
    # What was changed for the computation alone: a loop's carry keeps its shape, and the next step
    # its applied forces.
    contact = jax_fields(data).contact
    return with_contact(sensor_data.replace(xfrc_applied=data.xfrc_applied), contact, contact.dim)


def _existing(model: mjx.Model, data: mjx.Data) -> tuple[mjx.Model, mjx.Data]:
    """Returns the model and data without the equalities and contacts whose flags are disabled."""
    # MJX counts rows by the types of equalities and by the contacts, and finds forces of others.
    if model.opt.disableflags & _NO_EQUALITY:
        model = model.replace(eq_type=np.full_like(model.eq_type, _NO_TYPE))
    if model.opt.disableflags & _NO_CONTACT:
        no_contacts = jax.tree.map(lambda x: x[:0], jax_fields(data).contact)
        data = with_contact(data, no_contacts, no_contacts.dim[:0])
    return model, data


def with_tendons(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Returns the data with the forces of spatial tendons among the forces applied to bodies."""
    if not np.isin(mjx.WrapType.SITE, model.wrap_type):
        return data
    return data.replace(xfrc_applied=data.xfrc_applied + tendons.body_forces(model, data))
