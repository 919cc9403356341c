"""Solving with the inertia matrix from the leaves to the root: against C MuJoCo and MJX."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from mjx_reinforce.engine import scalar
from mjx_reinforce.engine.physics import contacts, inertia

#: A free body with two legs of two joints.
XML = """
<mujoco><option {option}/><worldbody><body pos="0 0 1"><freejoint/><geom size="0.2"/>
  <body pos="0.1 0.2 0"><joint axis="0 1 0" damping="2"/>
    <geom type="capsule" size="0.05 0.2" pos="0 0 -0.2"/>
    <body pos="0 0 -0.4"><joint axis="1 0 0"/>
      <geom type="capsule" size="0.04 0.2" pos="0 0 -0.2"/></body></body>
  <body pos="0.1 -0.2 0"><joint axis="0 1 0" damping="1"/>
    <geom type="capsule" size="0.05 0.2" pos="0 0 -0.2"/>
    <body pos="0 0 -0.4"><joint axis="1 0 0"/>
      <geom type="capsule" size="0.04 0.2" pos="0 0 -0.2"/></body></body>
</body></worldbody></mujoco>"""


def model_of(option=""):
    model = mujoco.MjModel.from_xml_string(XML.format(option=option))  # pyright: ignore
    return model, mjx.put_model(model, impl="jax")


def state(model, seed=0):
    """A random position and velocity, with all that follows from them in C."""
    random = np.random.default_rng(seed)
    data = mujoco.MjData(model)  # pyright: ignore
    data.qpos[:] += 0.3 * random.standard_normal(model.nq)
    data.qvel[:] = random.standard_normal(model.nv)
    mujoco.mj_forward(model, data)  # pyright: ignore
    return data, random.standard_normal(model.nv)


def written_out(fn, *args):
    """What machine code computes."""
    return jax.tree.map(lambda x: x[0], scalar.vmap(fn)(*jax.tree.map(lambda x: x[None], args)))


def at(model, in_jax, qpos, qvel):
    """Everything up to the constraints."""
    data = mjx.put_data(model, mujoco.MjData(model), impl="jax")  # pyright: ignore
    data = mjx.fwd_position(in_jax, data.replace(qpos=qpos, qvel=qvel))
    data = mjx.fwd_actuation(in_jax, mjx.fwd_velocity(in_jax, data))
    return inertia.fwd_acceleration(in_jax, data)


@pytest.mark.slow
def test_it_is_what_c_solves():
    with jax.enable_x64(True):
        model, in_jax = model_of()
        data, force = state(model)
        want = np.zeros((1, model.nv))
        mujoco.mj_solveM(model, data, want, force[None])  # pyright: ignore

        def both(qpos, qvel, force):
            reached = at(model, in_jax, qpos, qvel)
            return inertia.inverse_times(in_jax, reached, force), reached.qacc_smooth

        args = map(jnp.asarray, (data.qpos, data.qvel, force))
        solved, smooth = written_out(both, *args)
        np.testing.assert_allclose(solved, want[0], rtol=0, atol=1e-12 * np.abs(want).max())
        scale = np.abs(data.qacc_smooth).max()
        np.testing.assert_allclose(smooth, data.qacc_smooth, rtol=0, atol=1e-12 * scale)


@pytest.mark.slow
@pytest.mark.parametrize("option", ["", 'jacobian="sparse"'])
def test_a_step_of_euler_is_that_of_mjx(option):
    """With damping, which is part of the matrix, in both of MJX's layouts."""
    with jax.enable_x64(True):
        model, in_jax = model_of(option)
        data, _ = state(model, 1)

        def moved(qpos, qvel, *steps):
            reached = at(model, in_jax, qpos, qvel)
            reached = reached.replace(qacc=reached.qacc_smooth)
            return [(after.qpos, after.qvel) for step in steps for after in [step(in_jax, reached)]]

        args = tuple(map(jnp.asarray, (data.qpos, data.qvel)))
        want, got = jax.jit(lambda *args: moved(*args, mjx.euler, inertia.euler))(*args)
        dense = not option  # machine code has no other
        alone = written_out(lambda *args: moved(*args, inertia.euler), *args) if dense else []
        for each in (got, *alone):
            for mine, theirs in zip(each, want, strict=True):
                np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_without_implicit_damping_euler_is_that_of_mjx():
    """The damping at the step's end would change the velocity."""
    model, damped = model_of()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP  # pyright: ignore
    in_jax = mjx.put_model(model, impl="jax")
    data, _ = state(model, 1)
    data = mjx.put_data(model, data, impl="jax")
    steps = (inertia.euler, in_jax), (mjx.euler, in_jax), (mjx.euler, damped)
    ours, theirs, other = jax.jit(lambda data: [step(mx, data).qvel for step, mx in steps])(data)
    np.testing.assert_array_equal(ours, theirs)
    assert not np.allclose(ours, other)


def test_tendon_armature_couples_what_it_does_in_c():
    """Siblings are not coupled, a parent and its child are."""
    xml = """<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom size=".1" pos=".1 0 0"/>
      <body pos=".1 0 0"><joint name="b"/><geom size=".1" pos=".1 .1 0"/></body>
      <body pos="-.1 0 0"><joint name="c"/><geom size=".1" pos="-.1 .1 0"/></body></body>
      </worldbody><tendon><fixed armature=".01"><joint joint="a" coef="1"/>
      <joint joint="b" coef="2"/><joint joint="c" coef="-1"/></fixed></tendon></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)  # pyright: ignore
    in_jax, data = mjx.put_model(model, impl="jax"), mujoco.MjData(model)  # pyright: ignore
    data.qvel[:] = 1, 2, 3
    mujoco.mj_forward(model, data)  # pyright: ignore
    found = jax.jit(lambda data: contacts.fwd_position(in_jax, data))
    matrix = mjx.full_m(in_jax, found(mjx.put_data(model, data, impl="jax")))
    solved = np.linalg.solve(matrix, data.qfrc_smooth)
    assert matrix[0, 1] != 0
    np.testing.assert_allclose(solved, data.qacc_smooth, rtol=1e-5)


def test_zeros_stay_zeros():
    """A product is written for entries alone that a path from the root holds."""
    model, _ = model_of()
    coupled = np.eye(model.nv, dtype=bool)
    for dof, parent in enumerate(model.dof_parentid):
        coupled[dof] |= coupled[parent] if parent >= 0 else False
    above = coupled.sum(axis=1) - 1  # degrees of freedom between each and the root
    assert above.tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 6, 7]

    def solve(matrix, force):
        return inertia._from_leaves(jnp.where(coupled | coupled.T, matrix, 0), force)

    size = model.nv
    operations = scalar.scalarize(solve, jnp.eye(size), jnp.ones(size)).operations
    assert operations["sub"] == (above * (above + 1) // 2).sum() + 2 * above.sum()
    assert operations["div"] == size  # each pivot is inverted once


# -------------------------------------------------------------------------------------------------
# A step of ``implicitfast`` is that of C MuJoCo, also where actuators are clamped.

BOX = '<geom type="box" size=".1 .2 .3"/>'
#: A hinge each, with an actuator at its clamp; tests/experiments/test_matrix.py has all of them.
HINGES = {
    "servo at its limit": '<position joint="{0}" kp="200" kv="20" forcerange="-3 3"/>',
    "damper, more control than its range": '<damper joint="{0}" kv="3" ctrlrange="0 .5"/>',
    "muscle": '<muscle joint="{0}" lengthrange="-2 2" force="30"/>',
}
TWO_LINKS = (
    '<joint name="{0}"/><geom size=".1" pos="0 .2 0"/>'
    '<body pos="0 .4 0"><joint name="{0} a"/><geom size=".1" pos="0 .2 0"/></body>'
)
#: What has more degrees of freedom: bodies, actuators, tendons.
OTHERS = {
    "free": ('<freejoint name="{0}"/>' + BOX, "", ""),
    "free, off its center": ('<joint name="{0}" type="free" armature=".1"/>'
        '<geom type="box" size=".1 .2 .3" pos=".2 .1 0" euler="20 30 0"/>', "", ""),
    "free, driven": ('<freejoint name="{0}"/><geom type="box" size=".1 .2 .3" pos=".1 0 0"/>'
        '<site name="{0}" pos=".2 0 0"/>', '<general site="{0}" refsite="world" '
        'gear="9 5 0 0 0 7" biastype="affine" biasprm="0 -1 -2" gainprm="1"/>', ""),
    "free, with a fixed body": ('<freejoint name="{0}"/>' + BOX
        + '<body pos=".2 0 0" euler="10 20 30">' + BOX + "</body>", "", ""),
    "free, with a joint": ('<freejoint name="{0}"/>' + BOX
        + '<body pos=".2 0 0"><joint name="{0} a"/>' + BOX + "</body>", "", ""),
    "tendon between joints at their limits": (
        '<joint name="{0}" actuatorfrcrange="-.1 .1"/><geom size=".1" pos="0 .2 0"/>',
        '<velocity tendon="{0}" kv="2"/>',
        '<fixed name="{0}"><joint joint="{0}" coef="1"/></fixed>'),
    "ball": ('<joint name="{0}" type="ball"/>' + BOX, "", ""),
    "damped tendon of siblings": (
        '<joint name="{0}" axis="0 1 0"/><geom size=".1" pos=".1 0 0"/>'
        '<body><joint name="{0} a"/><geom size=".1" pos="0 .2 0"/></body>'
        '<body><joint name="{0} b"/><geom size=".1" pos="0 -.2 0"/></body>', "",
        '<fixed name="{0}" damping="3"><joint joint="{0} a" coef="1"/>'
        '<joint joint="{0} b" coef="2"/></fixed>'),
    "damped tendon of slides": (
        '<joint name="{0}" type="slide" axis="1 0 0"/><geom size=".1"/>'
        '<joint name="{0} a" type="slide" axis="0 1 0"/>', "",
        '<fixed name="{0}" damping="3"><joint joint="{0}" coef="1"/>'
        '<joint joint="{0} a" coef="2"/></fixed>'),
    "tendon at its limit": (TWO_LINKS,
        '<position tendon="{0}" kp="20" kv="2"/><velocity tendon="{0}" kv="3"/>'
        '<velocity joint="{0}" kv="1"/>',
        '<fixed name="{0}" actuatorfrcrange="-1 1"><joint joint="{0}" coef="1"/>'
        '<joint joint="{0} a" coef="2"/></fixed>'),
    "tendon below its limit, since an actuator is at its own": (TWO_LINKS,
        '<position tendon="{0}" kp="20" kv="2" forcerange="-.1 .1"/>'
        '<velocity tendon="{0}" kv="3"/>',
        '<fixed name="{0}" actuatorfrcrange="-1 1"><joint joint="{0}" coef="1"/>'
        '<joint joint="{0} a" coef="2"/></fixed>'),
}  # fmt: skip
#: What machine code plays, which takes minutes to compile with all.
FEW = (*HINGES, "free, off its center", "tendon at its limit")


def compiled(chosen):
    """Returns a model of cases beside each other, and the case of each degree of freedom."""
    hinge = '<joint name="{0}" axis="0 1 0"/><geom size=".05" pos=".3 0 0"/>'
    cases = {name: (hinge, act, "") for name, act in HINGES.items()} | OTHERS
    cases = {name: cases[name] for name in chosen}
    parts = [[part.format(name) for part in case] for name, case in cases.items()]
    bodies, actuators, tendons = ("".join(part) for part in zip(*parts, strict=True))
    bodies = "".join(f'<body pos="0 {i} 0">{part[0]}</body>' for i, part in enumerate(parts))
    model = mujoco.MjModel.from_xml_string(  # pyright: ignore
        f'<mujoco><option integrator="implicitfast" timestep=".01"><flag contact="disable"/>'
        f'</option><worldbody><site name="world"/>{bodies}</worldbody>'
        f"<tendon>{tendons}</tendon><actuator>{actuators}</actuator></mujoco>"
    )
    return model, np.array([model.joint(joint).name for joint in model.dof_jntid])


@pytest.mark.slow
@pytest.mark.parametrize(("engine", "chosen"), [(jax.vmap, HINGES | OTHERS), (scalar.vmap, FEW)])
def test_a_step_is_that_of_c(engine, chosen):
    with jax.enable_x64(True):
        model, names = compiled(chosen)
        data = mujoco.MjData(model)  # pyright: ignore
        data.qvel[:] = 3 * np.cos(1 + np.arange(model.nv))
        data.ctrl[:], data.act[:] = 1, 0.7
        mujoco.mj_forward(model, data)  # pyright: ignore
        in_jax, start = mjx.put_model(model, impl="jax"), mjx.put_data(model, data, impl="jax")
        mujoco.mj_implicit(model, data)  # pyright: ignore
        leaves, tree = jax.tree.flatten(start)

        def advance(*leaves):
            return inertia.implicitfast(in_jax, jax.tree.unflatten(tree, leaves)).qvel

        [qvel] = np.asarray(jax.jit(engine(advance))(*(jnp.asarray(x)[None] for x in leaves)))
    wrong = np.abs(qvel - data.qvel) > 1e-11 * (1 + np.abs(data.qvel))
    assert sorted(set(names[wrong].tolist())) == []
