"""Small models that each have one feature of MuJoCo, for `own_models.py` and its test."""

_ARM = """
<mujoco>
  <option {option}>{flags}</option>
  {top}
  <default><geom contype="0" conaffinity="0" density="800"/></default>
  <worldbody>
    <site name="wall" pos=".3 0 .2"/>
    {world}
    <body name="upper" pos="0 0 1" {upper}>
      <joint name="a" axis="0 1 0" damping=".2" {joint}/>
      <geom name="upper" type="capsule" fromto="0 0 0 .4 0 0" size=".05"/>
      <site name="middle" pos=".2 0 .05"/>
      <body name="lower" pos=".4 0 0">
        <joint name="b" {hinge}/>
        <geom name="lower" type="capsule" fromto="0 0 0 .3 0 0" size=".04"/>
        <site name="tip" pos=".3 .02 0"/>
      </body>
    </body>
  </worldbody>
  <actuator>{actuator}</actuator>
  {rest}
</mujoco>
"""
_SCENE = """
<mujoco>
  <option {option}>{flags}</option>
  {top}
  <worldbody>
    <geom name="floor" {floor}/>
    <body name="thing" pos="{pos}">
      <freejoint/>
      <geom name="thing" size=".1 .12 .14" density="500" {geom}/>
    </body>
    <body pos="3 0 1">
      <joint name="a" axis="0 1 0"/>
      <geom type="sphere" size=".1" contype="0" conaffinity="0"/>
    </body>
    {world}
  </worldbody>
  <actuator><motor joint="a"/></actuator>
  {rest}
</mujoco>
"""
_MOTOR = '<motor joint="a" gear="2"/>'
_FIXED = (
    '<tendon><fixed name="t" {0}><joint joint="a" coef="1"/><joint joint="b" coef="-.5"/></fixed>'
    "</tendon>"
)
_SPATIAL = (
    '<tendon><spatial name="t" {0}><site site="wall"/>{1}<site site="tip"/></spatial></tendon>'
)
_TETRAHEDRON = (
    '<asset><mesh name="m" vertex=".2 0 -.1  -.1 .17 -.1  -.1 -.17 -.1  0 0 .2"/></asset>'
)
_HILLS = (
    '<asset><hfield name="h" nrow="3" ncol="3" size="2 2 .2 .1" '
    'elevation="0 .2 0 .1 .3 .2 0 .1 0"/></asset>'
)


def _arm(**parts: str) -> str:
    """Returns two links that swing freely, moved at their first joint, with parts added."""
    empty = dict.fromkeys(("option", "flags", "top", "world", "upper", "joint", "rest"), "")
    return _ARM.format_map({**empty, "hinge": 'axis="0 1 0"', "actuator": _MOTOR, **parts})


def _actuated(actuator: str, rest: str = "", **parts: str) -> str:
    return _arm(actuator=actuator, rest=rest, **parts)


def _scene(geom: str, **parts: str) -> str:
    """Returns a free body just in contact with the floor, with parts added."""
    empty = dict.fromkeys(("option", "flags", "top", "world", "rest"), "")
    plane = 'type="plane" size="5 5 .1"'
    return _SCENE.format_map({**empty, "floor": plane, "pos": "0 0 .099", "geom": geom, **parts})


def _sensors(*sensors: str) -> str:
    return _arm(rest=f"<sensor>{''.join(f'<{sensor}/>' for sensor in sensors)}</sensor>")


#: Name -> MJCF.
MODELS = {
    # Actuators
    "motor": _arm(),
    "position": _actuated('<position joint="a" kp="20" kv="1"/>'),
    "position, timeconst": _actuated('<position joint="a" kp="20" kv="1" timeconst=".05"/>'),
    "velocity": _actuated('<velocity joint="a" kv="3"/>'),
    "intvelocity": _actuated('<intvelocity joint="a" kp="20" actrange="-1 1"/>'),
    "damper": _actuated('<damper joint="a" kv="3" ctrlrange="0 1"/>'),
    "cylinder": _actuated('<cylinder joint="a" timeconst=".1" area=".5"/>'),
    "muscle": _actuated(
        '<muscle tendon="t" ctrlrange="0 1" lengthrange=".2 1.2" force="30"/>',
        _SPATIAL.format("", ""),
    ),
    "integrator": _actuated('<general joint="a" dyntype="integrator" gainprm="5"/>'),
    "filter": _actuated('<general joint="a" dyntype="filter" dynprm=".1" gainprm="5"/>'),
    "filterexact": _actuated('<general joint="a" dyntype="filterexact" dynprm=".1" gainprm="5"/>'),
    "filter, RK4": _actuated(
        '<general joint="a" dyntype="filter" dynprm=".1" gainprm="5"/>', option='integrator="RK4"'
    ),
    "filter, implicitfast": _actuated(
        '<general joint="a" dyntype="filter" dynprm=".1" gainprm="5"/>',
        option='integrator="implicitfast"',
    ),
    "actlimited": _actuated(
        '<general joint="a" dyntype="integrator" gainprm="5" actlimited="true" actrange="-.1 .1"/>'
    ),
    "actearly": _actuated(
        '<general joint="a" dyntype="filter" dynprm=".1" gainprm="5" actearly="true"/>'
    ),
    "affine gain": _actuated(
        '<general joint="a" gaintype="affine" gainprm="3 .5 -.2" biastype="affine" '
        'biasprm="0 -2 -.3"/>'
    ),
    "forcerange": _actuated('<motor joint="a" gear="3" forcerange="-.4 .4"/>'),
    "ctrlrange": _actuated('<motor joint="a" gear="3" ctrlrange="-.4 .4"/>'),
    "two actuators": _actuated('<motor joint="a"/><intvelocity joint="b" kp="5" actrange="-2 2"/>'),
    "jointinparent": _actuated('<motor jointinparent="b"/>', hinge='type="ball"'),
    "motor of a ball": _actuated('<motor joint="b" gear="1 .5 .2"/>', hinge='type="ball"'),
    "site transmission": _actuated('<motor site="tip" gear="1 0 2 0 .1 0"/>'),
    "site with refsite": _actuated(
        '<position site="tip" refsite="wall" gear="1 0 1 0 0 0" kp="30"/>'
    ),
    "tendon transmission": _actuated('<motor tendon="t"/>', _FIXED.format("")),
    "armature of an actuator": _actuated('<motor joint="a" armature=".05"/>'),
    "damping of an actuator": _actuated('<motor joint="a" damping=".3"/>'),
    "adhesion": _actuated('<adhesion body="lower" ctrlrange="0 1" gain="2"/>'),
    "slider-crank": _actuated(
        '<general cranksite="tip" slidersite="wall" cranklength=".5" gainprm="3"/>'
    ),
    "delay": _actuated('<motor joint="a" delay=".01" nsample="8"/>'),
    "plugin": _actuated(
        '<plugin joint="a" plugin="mujoco.pid"><config key="kp" value="4"/></plugin>',
        top='<extension><plugin plugin="mujoco.pid"/></extension>',
    ),
    # Joints
    "ball joint": _arm(hinge='type="ball" damping=".05"'),
    "slide joint": _arm(hinge='type="slide" axis="1 0 0" stiffness="50" damping="1"'),
    "joint limit": _arm(joint='range="-6 6"'),
    "ball limit": _arm(hinge='type="ball" range="0 20"'),
    "armature": _arm(joint='armature=".1"'),
    "joint spring": _arm(joint='stiffness="5" springref="20"'),
    "polynomial spring": _arm(joint='stiffness="5 1 .5"'),
    "polynomial damping": _arm(hinge='axis="0 1 0" damping=".5 .3 .2"'),
    "springyield": _arm(joint='stiffness="5" springyield=".1"'),
    "friction loss": _arm(joint='frictionloss=".3"'),
    "actuatorfrcrange": _arm(joint='actuatorfrcrange="-.5 .5"'),
    "gravity compensation": _arm(upper='gravcomp="1"'),
    "gravity compensation by actuators": _arm(
        upper='gravcomp="1"', joint='actuatorgravcomp="true" actuatorfrcrange="-3 3"'
    ),
    # Tendons
    "fixed tendon": _arm(rest=_FIXED.format('stiffness="4" damping=".2"')),
    "spatial tendon": _arm(rest=_SPATIAL.format('stiffness="40" springlength=".2"', "")),
    "polynomial spring of a tendon": _arm(rest=_FIXED.format('stiffness="4 2 1"')),
    "tendon limit": _arm(rest=_FIXED.format('range="-.1 .1"')),
    "tendon friction": _arm(rest=_FIXED.format('frictionloss=".3"')),
    "tendon armature": _arm(rest=_SPATIAL.format('armature=".2"', "")),
    "tendon actuatorfrcrange": _actuated(
        '<motor tendon="t" gear="3"/>', _FIXED.format('actuatorfrcrange="-.4 .4"')
    ),
    "tendon over a sphere": _arm(
        world='<geom name="pin" type="sphere" size=".1" pos=".35 0 .55"/>',
        rest=_SPATIAL.format('stiffness="40" springlength=".2"', '<geom geom="pin"/>'),
    ),
    "tendon over a cylinder": _arm(
        world='<geom name="pin" type="cylinder" size=".1 .2" zaxis="0 1 0" pos=".35 0 .55"/>',
        rest=_SPATIAL.format('stiffness="40" springlength=".2"', '<geom geom="pin"/>'),
    ),
    "tendon through a cylinder": _arm(
        world='<geom name="pin" type="cylinder" size=".1 .2" zaxis="0 1 0" pos=".35 0 .55"/>'
        '<site name="side" pos=".35 0 .55"/>',
        rest=_SPATIAL.format(
            'stiffness="40" springlength=".2"', '<geom geom="pin" sidesite="side"/>'
        ),
    ),
    "pulley": _arm(
        rest=_SPATIAL.format(
            'stiffness="40" springlength=".2"',
            '<site site="middle"/><pulley divisor="2"/><site site="middle"/>',
        )
    ),
    # Equalities
    "connect": _arm(
        rest='<equality><connect body1="lower" body2="world" anchor=".3 0 0"/></equality>'
    ),
    "weld": _arm(rest='<equality><weld body1="lower" body2="world"/></equality>'),
    "weld to mocap": _arm(
        world='<body name="hand" mocap="true" pos=".7 0 1"/>',
        rest='<equality><weld body1="lower" body2="hand" relpose="0 0 0 1 0 0 0"/></equality>',
    ),
    "joint equality": _arm(
        rest='<equality><joint joint1="b" joint2="a" polycoef=".1 .5 .2 0 0"/></equality>'
    ),
    "tendon equality": _arm(
        rest=_FIXED.format("") + '<equality><tendon tendon1="t" polycoef=".1 0 0 0 0"/></equality>'
    ),
    "inactive equality": _arm(
        rest='<equality><weld body1="lower" body2="world" active="false"/></equality>'
    ),
    # Sensors
    "sensors of positions": _sensors(
        'jointpos joint="a"',
        'actuatorpos actuator="act"',
        'framepos objtype="site" objname="tip"',
        'framequat objtype="body" objname="lower"',
        'subtreecom body="upper"',
        "clock",
    ).replace("<motor ", '<motor name="act" '),
    "sensors of velocities": _sensors(
        'jointvel joint="a"',
        'gyro site="tip"',
        'velocimeter site="tip"',
        'framelinvel objtype="site" objname="tip"',
        'subtreeangmom body="upper"',
    ),
    "sensors of accelerations": _sensors(
        'accelerometer site="tip"',
        'force site="tip"',
        'torque site="tip"',
        'frameangacc objtype="site" objname="tip"',
    ),
    "rangefinder": _sensors('rangefinder site="tip"'),
    # Integrators, solvers, cones, flags
    "Euler without implicit damping": _arm(flags='<flag eulerdamp="disable"/>'),
    "implicitfast": _arm(option='integrator="implicitfast"'),
    "implicit": _arm(option='integrator="implicit"'),
    "discrete": _arm(option='integrator="discrete"'),
    "RK4": _arm(option='integrator="RK4"', hinge='type="ball"'),
    "CG": _scene('type="sphere"', option='solver="CG"'),
    "PGS": _scene('type="sphere"', option='solver="PGS"'),
    "elliptic cone": _scene('type="sphere"', option='cone="elliptic"'),
    "impratio": _scene('type="sphere"', option='cone="elliptic" impratio="5"'),
    "noslip": _scene('type="sphere"', option='noslip_iterations="5"'),
    "energy": _arm(flags='<flag energy="enable"/>'),
    "sleep": _scene('type="sphere"', flags='<flag sleep="enable"/>'),
    "disabled actuators": _actuated(
        '<motor joint="a" group="2"/>', option='actuatorgroupdisable="2"'
    ),
    "disabled springs": _arm(joint='stiffness="2"', flags='<flag spring="disable"/>'),
    "disabled dampers": _arm(flags='<flag damper="disable"/>'),
    "no gravity": _arm(flags='<flag gravity="disable"/>'),
    "wind": _arm(option='density="10" viscosity=".5" wind="3 0 1"'),
    "fluid": _arm(option='density="100" viscosity="1"'),
    "ellipsoid fluid": _arm(option='density="100" viscosity="1"').replace(
        'name="lower" type', 'fluidshape="ellipsoid" name="lower" type'
    ),
    # Contacts
    "sphere on a plane": _scene('type="sphere"'),
    "capsule on a plane": _scene('type="capsule" euler="0 80 0"', pos="0 0 .12"),
    "box on a plane": _scene('type="box" euler="3 5 0"', pos="0 0 .154"),
    "cylinder on a plane": _scene('type="cylinder" euler="80 3 0"', pos="0 0 .119"),
    "ellipsoid on a plane": _scene('type="ellipsoid" euler="0 10 0"', pos="0 0 .138"),
    "mesh on a plane": _scene('type="mesh" mesh="m"', top=_TETRAHEDRON),
    "mesh on a box": _scene(
        'type="mesh" mesh="m"', top=_TETRAHEDRON, floor='type="box" size="2 2 .1" pos="0 0 -.1"'
    ),
    "sphere on a heightfield": _scene(
        'type="sphere"', top=_HILLS, floor='type="hfield" hfield="h"', pos="0 0 .299"
    ),
    "sphere on a box": _scene('type="sphere"', floor='type="box" size="2 2 .1" pos="0 0 -.1"'),
    "box on a box": _scene(
        'type="box" euler="3 5 0"', floor='type="box" size="2 2 .1" pos="0 0 -.1"', pos="0 0 .154"
    ),
    "capsule on a capsule": _scene(
        'type="capsule" euler="0 90 0"',
        floor='type="capsule" size=".1 1" euler="90 0 0" pos="0 0 -.1"',
    ),
    "condim 1": _scene('type="sphere" condim="1"', floor='type="plane" size="5 5 .1" condim="1"'),
    "condim 4": _scene('type="sphere" condim="4"'),
    "condim 6": _scene('type="sphere" condim="6" friction="1 .02 .01"'),
    "margin": _scene('type="sphere" margin=".05" gap=".02"'),
    "solref and solimp": _scene('type="sphere" solref="-300 -20" solimp=".5 .9 .1 .4 3"'),
    "contact pair": _scene(
        'type="sphere" contype="0"',
        rest='<contact><pair geom1="thing" geom2="floor" condim="3" friction=".3 .3 .01 .01 .01"/>'
        "</contact>",
    ),
    "adhesive geom": _scene('type="sphere" adhesion="5"'),
    "moving surface": _scene(
        'type="sphere"', floor='type="plane" size="5 5 .1" surfacevel="1 0 0"'
    ),
    "flex": _scene(
        'type="sphere"',
        world='<flexcomp name="f" type="grid" count="3 3 1" spacing=".1 .1 .1" pos="0 0 2" '
        'radius=".01"><edge equality="true"/></flexcomp>',
    ),
}
