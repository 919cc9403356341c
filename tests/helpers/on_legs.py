"""Robots on any number of legs, as MJCF."""


def on_legs(num_legs):
    """Returns a body on legs in a circle, each of which swings, folds and turns out."""
    legs = "".join(
        f"""
        <body euler="0 0 {360 * leg / num_legs + 10}"><body pos="0.3 0 0">
          <joint name="out{leg}" axis="1 0 0"/><geom size="0.03" contype="0" conaffinity="0"/>
          <body euler="0 30 0"><joint name="swing{leg}" axis="0 1 0"/>
            <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" contype="0" conaffinity="0"/>
            <body pos="0 0 -0.2" euler="0 -60 0"><joint name="knee{leg}" axis="0 1 0"/>
              <geom name="shin{leg}" size="0.02" pos="0 0 -0.1"/>
              <geom name="foot{leg}" size="0.02" pos="0 0 -0.2"/>
        </body></body></body></body>"""
        for leg in range(num_legs)
    )
    servos = "".join(
        f'<position joint="{name}{leg}"/>'
        for name in ("knee", "out", "swing")
        for leg in range(num_legs)
    )
    return f"""<mujoco><worldbody><geom type="plane" size="0 0 1"/>
      <body name="trunk" pos="0 0 0.37">
        <freejoint/><geom size="0.05" mass="5"/>{legs}</body></worldbody>
      <actuator>{servos}</actuator></mujoco>"""
