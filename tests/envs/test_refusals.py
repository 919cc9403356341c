"""What MJX reads otherwise than C MuJoCo: computed as C does, or refused in words, all at once."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_reinforce import make_vec
from mjx_reinforce.envs import models
from mjx_reinforce.envs.base import MujocoEnv
from mjx_reinforce.envs.refusals import UnsupportedError

read = mujoco.MjModel.from_xml_string  # pyright: ignore[reportAttributeAccessIssue]


class Shown(MujocoEnv):
    """A model that shows some fields."""

    def __init__(self, model, fields, forces):
        """Takes the model, and the names of fields of mjData."""
        super().__init__(xml_file=model, frame_skip=2, max_episode_steps=100, reward_threshold=None)
        self.fields, self.contact_forces = fields, forces

    def initial(self, rng):
        """Returns the model's pose."""
        return jnp.asarray(self.mj_model.qpos0), jnp.zeros(self.mj_model.nv)

    def observe(self, data):
        """Returns the fields, one after the other."""
        return jnp.concatenate([jnp.ravel(getattr(data, name)) for name in self.fields])

    def outcome(self, before, data, action):
        """Earns nothing."""
        return 0.0, False, {}


def error_beside_c(text, engine="vmap", fields=("qpos", "qvel"), steps=10, forces=False):
    """Returns the largest error in some env steps, relative to numbers beyond 1."""
    model = read(text)
    model.opt.tolerance, model.opt.iterations = 0, 100
    data, worst = mujoco.MjData(model), 0.0  # pyright: ignore[reportAttributeAccessIssue]
    with jax.enable_x64(True):
        vec = make_vec(Shown(model, fields, forces), 1, engine=engine)
        step, state = jax.jit(vec.step), vec.reset(jax.random.key(0))
        for _ in range(steps):
            state = step(state, jnp.zeros((1, model.nu)))
            mujoco.mj_step(model, data, 2)  # pyright: ignore[reportAttributeAccessIssue]
            if forces:
                mujoco.mj_rnePostConstraint(model, data)  # pyright: ignore
            theirs = np.concatenate([getattr(data, name).ravel() for name in fields])
            error = np.abs(np.asarray(state.obs[0]) - theirs) / np.maximum(1, np.abs(theirs))
            worst = max(worst, float(np.nan_to_num(error, nan=np.inf).max()))
    return worst


SLIDE = '<joint type="slide" axis="0 0 1"/><geom size=".1" mass="1" {}/>'
RESTING = f"""<mujoco>{{}}<worldbody><geom type="plane" size="1 1 1" {{}}/>
  <body pos="0 0 .098"><joint name="a" type="slide" axis="0 0 1"/><geom size=".1" mass="1"/></body>
  <body pos="1 0 .098">{SLIDE.format("")}</body></worldbody>
  <actuator><motor joint="a"/></actuator></mujoco>"""
LIMITS_OF_MJX = """<custom><numeric name="other" data="7 8 9"/>
  <numeric name="max_contact_points" data="1"/><numeric name="max_geom_pairs" data="1"/></custom>"""


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["vmap", "native"])
def test_numerics_of_mjx_drop_no_contacts(engine):
    """To C MuJoCo they are the user's own numbers, as any other."""
    assert error_beside_c(RESTING.format(LIMITS_OF_MJX, ""), engine, steps=50) < 1e-9


def test_the_users_model_keeps_its_numerics():
    model = read(RESTING.format(LIMITS_OF_MJX, ""))
    loaded = models.load_model(model)
    assert model.numeric("max_contact_points").data.tolist() == [1]
    assert loaded.numeric("other").data.tolist() == [7, 8, 9]


FALLING = {
    "of a contact": ('<default><geom solimp=".95 .5 .01"/></default>', ""),
    "mixed before it is clipped": (
        '<default><geom solimp="2 1 .01"/></default>',
        'solimp=".9999 .9 .01 .3 3"',
    ),
    "of elliptic cones": (
        '<option cone="elliptic"/><default><geom solimp=".95 .5 .01"/></default>',
        "",
    ),
    "without width": ('<default><geom solimp=".5 .9 0"/></default>', ""),
    "of friction loss": (
        '<default><joint frictionloss=".5" solimpfriction=".99 .2 1"/></default>',
        "",
    ),
    "of a limit": (
        '<default><joint range=".001 1" solimplimit=".99 .2 .01"/></default>',
        'contype="0" conaffinity="0"',
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", FALLING)
@pytest.mark.parametrize("engine", ["vmap", "native"])
def test_a_solimp_may_fall(case, engine):
    """As C MuJoCo interpolates it, where MJX clips."""
    text = RESTING.format(*FALLING[case])
    if "range" in text:
        text = text.replace("<mujoco>", '<mujoco><compiler autolimits="true"/>')
    assert error_beside_c(text, engine) < 1e-9


SENSING = """<mujoco>{}<worldbody><geom type="plane" size="1 1 1" contype="{}"/>
  <body name="b" pos="0 0 .05"><joint name="a" axis="0 1 0"/>
    <geom size=".1" pos=".1 0 0" conaffinity="{}" contype="0" mass="1"/><site name="s" size=".3"/>
  </body></worldbody><actuator><motor joint="a"/></actuator>{}
  <sensor><touch site="s"/><force site="s"/><torque site="s"/><accelerometer site="s"/></sensor>
</mujoco>"""
HELD = '<equality><weld body1="b"/><connect body1="b" anchor=".1 0 0"/></equality>'
OFF = '<option><flag {}="disable"/></option>'
NO_ROWS = {
    "no contacts": SENSING.format("", 0, 0, ""),
    "constraint": SENSING.format(OFF.format("constraint"), 1, 1, ""),
    "constraint and a weld": SENSING.format(OFF.format("constraint"), 1, 1, HELD),
    "equality": SENSING.format(OFF.format("equality"), 0, 0, HELD),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", NO_ROWS)
@pytest.mark.parametrize("engine", ["vmap", "native"])
def test_what_is_not_there_pushes_nothing(case, engine):
    """Neither on a sensor nor on a body; a touch sensor reads 0."""
    fields = ("qpos", "qvel", "sensordata", "cfrc_ext", "cfrc_int")
    assert error_beside_c(NO_ROWS[case], engine, fields, forces=True) < 1e-9


IDLE = """<mujoco><option><flag {}="disable"/></option><worldbody>
  <geom type="box" size="1 1 .1"/><body pos="0 0 .15"><joint name="a" type="slide" axis="0 0 1"/>
    <geom type="ellipsoid" size=".1 .2 .3" mass="1"/></body></worldbody>
  <actuator><motor joint="a"/></actuator></mujoco>"""


@pytest.mark.slow
@pytest.mark.parametrize("flag", ["constraint", "contact"])
def test_pairs_that_a_flag_disables_need_no_contact_of_mjx(flag):
    """dm_control's fish: MJX has no ellipsoid on a box, and looks for one all the same."""
    assert error_beside_c(IDLE.format(flag), "vmap") < 1e-9


MANY = """<mujoco model="many"><option solver="PGS" noslip_iterations="3" cone="elliptic"/>
  <asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset><worldbody>
  <body name="u"><joint name="j"/><geom type="cylinder" size=".1 .1" condim="1"/>
    <geom type="cylinder" size=".1 .1" condim="1"/><geom type="cylinder" size=".1 .1"/></body>
  <body name="v"><freejoint/><geom name="drum" type="cylinder" size=".1 .1" condim="1"/>
    <geom name="can" type="cylinder" size=".1 .1" condim="1"/></body>
  <body><freejoint/><geom type="sdf" mesh="m" contype="2" conaffinity="2"/></body>
  <body><freejoint/><geom name="ball" size="1" contype="2" conaffinity="2"/></body>
</worldbody></mujoco>"""


def test_all_reasons_come_at_once_with_the_names():
    with pytest.raises(UnsupportedError) as caught:
        models.load_model(read(MANY))  # also where it has no actuator
    said = str(caught.value).splitlines()
    assert said[0] == "MJX cannot run the model 'many', for 6 reasons:"
    for number, parts in enumerate(
        (
            ("it has no actuators; add an <actuator>",),
            ("noslip_iterations; remove it",),
            ("mjSOL_PGS", 'solver="Newton"'),
            (
                "6 pairs of cylinder on cylinder, which MJX finds in ten steps",
                "(geom 0 of body u and drum, geom 0 of body u and can, geom 1 of body u and drum, "
                "and 3 more)",
                '<exclude body1="u" body2="v"/>',
            ),
            ("1 pair of sdf on sphere, which MJX has not (ball and geom 0 of body number 3)",),
            ("no contacts of condim 1 in elliptic cones", 'cone="pyramidal"'),
        ),
        start=1,
    ):
        assert said[number].startswith(f"  {number}. ")
        assert all(part in said[number] for part in parts)
    assert len(said) == 7
    assert "exclude" not in said[5]  # a body without a name cannot be excluded


def test_an_error_of_mjx_is_no_refusal(monkeypatch):
    def fail(*_, **__):
        raise TypeError("from elsewhere")

    monkeypatch.setattr(models.mjx, "put_model", fail)
    with pytest.raises(ValueError, match="to MJX fails: TypeError: from elsewhere") as caught:
        models.to_mjx(read(RESTING.format("", "")), "mine.xml")
    assert not isinstance(caught.value, UnsupportedError)
