"""A step of ``implicitfast`` is that of C MuJoCo, also where actuators are clamped."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from mjx_reinforce.engine import scalar
from mjx_reinforce.engine.physics import inertia

BOX = '<geom type="box" size=".1 .2 .3"/>'
#: A hinge each: its actuators; after a bar, attributes of the joint.
HINGES = {
    "servo": '<position joint="{0}" kp="20" kv="1"/>',
    "servo at its limit": '<position joint="{0}" kp="200" kv="20" forcerange="-3 3"/>',
    "servo below its limit": '<position joint="{0}" kp="2" kv="2" forcerange="-30 30"/>',
    "servo, joint's limit": '<position joint="{0}" kp="200" kv="20"/>|actuatorfrcrange="-1 1"',
    "servo, activated":
        '<position joint="{0}" kp="20" kv="2" timeconst=".1" forcerange="-.5 .5"/>',
    "damper": '<damper joint="{0}" kv="3" ctrlrange="0 2"/>',
    "damper, more control than its range": '<damper joint="{0}" kv="3" ctrlrange="0 .5"/>',
    "damper, activated":
        '<general joint="{0}" dyntype="filter" dynprm=".1" gaintype="affine" gainprm="1 .2 -3"/>',
    "velocity at its limit": '<velocity joint="{0}" kv="3" forcerange="-.1 .1"/>',
    "muscle": '<muscle joint="{0}" lengthrange="-2 2" force="30"/>',
    "muscle at its limit":
        '<muscle joint="{0}" lengthrange="-2 2" force="30" forcerange="-1 0"/>',
    "two, their sum at the joint's limit": '<velocity joint="{0}" kv="3"/>'
        '<motor joint="{0}" gear="20"/>|actuatorfrcrange="-1 1"',
    "two, one at its limit": '<position joint="{0}" kp="20" kv="1" forcerange="-1 1"/>'
        '<velocity joint="{0}" kv="2"/>',
    "gear": '<position joint="{0}" kp="20" kv="1" gear="3" forcerange="-9 9"/>',
    "motor and damping": '<motor joint="{0}"/>|damping="2"',
}  # fmt: skip
TWO_LINKS = (
    '<joint name="{0}"/><geom size=".1" pos="0 .2 0"/>'
    '<body pos="0 .4 0"><joint name="{0} a"/><geom size=".1" pos="0 .2 0"/></body>'
)
#: What has more degrees of freedom: bodies, actuators, tendons.
OTHERS = {
    "free": ('<freejoint name="{0}"/>' + BOX, "", ""),
    "free, off its centre": ('<joint name="{0}" type="free" armature=".1"/>'
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
FEW = (
    *("servo at its limit", "damper, more control than its range", "muscle"),
    *("free, off its centre", "tendon at its limit"),
)


def compiled(chosen):
    """Returns a model of cases beside each other, and the case of each degree of freedom."""
    hinge = '<joint name="{0}" axis="0 1 0" {1}/><geom size=".05" pos=".3 0 0"/>'
    parts = {name: text.partition("|") for name, text in HINGES.items()}
    cases = {name: (hinge.format(name, joint), act, "") for name, (act, _, joint) in parts.items()}
    cases = {name: (cases | OTHERS)[name] for name in chosen}
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
