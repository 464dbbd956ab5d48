"""MuJoCo 4.0 as one of the simulators: `pip install mujoco`. 3D: walls are boxes, the robot a body
on two driven wheels and two casters, whose lidar is a ring of rangefinders.
"""

import math

import mujoco
import numpy as np

WHEEL, TRACK = 0.036, 0.233  # metres: radius of a wheel, distance between both
HEIGHT = 0.2  # of the lidar above the axle
MODEL = """
<mujoco>
  <option timestep="0.004" integrator="implicitfast"/>
  <visual><headlight ambient=".45 .45 .45" diffuse=".4 .4 .4"/></visual>
  <worldbody>
    <light pos="{middle} 6" dir="0 0 -1" directional="true" diffuse=".5 .5 .5"/>
    <geom type="plane" size="0 0 .1" rgba=".86 .84 .8 1" friction="1 .005 .0001"/>
    {walls}
    <body name="robot" pos="{x} {y} {wheel}" euler="0 0 {angle}">
      <freejoint/>
      <geom name="body" type="cylinder" size="{radius} .04" pos="0 0 .035" mass="2.9"
            friction=".3" rgba=".2 .45 .8 1"/>
      <geom type="sphere" size=".015" pos=".12 0 -.02" mass=".1" condim="1" friction="0"/>
      <geom type="sphere" size=".015" pos="-.12 0 -.02" mass=".1" condim="1" friction="0"/>
      <camera name="eye" pos="0 0 {lidar}" xyaxes="0 -1 0 0 0 1" fovy="{fovy}"/>
      {sites}
      <body pos="0 {half} 0">
        <joint name="left" axis="0 1 0" armature=".002"/>
        <geom type="cylinder" size="{wheel} .01" zaxis="0 1 0" mass=".1" rgba=".1 .1 .1 1"/>
      </body>
      <body pos="0 -{half} 0">
        <joint name="right" axis="0 1 0" armature=".002"/>
        <geom type="cylinder" size="{wheel} .01" zaxis="0 1 0" mass=".1" rgba=".1 .1 .1 1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <velocity joint="left" kv=".3" forcerange="-.4 .4"/>
    <velocity joint="right" kv=".3" forcerange="-.4 .4"/>
  </actuator>
  <sensor>{sensors}</sensor>
</mujoco>
"""
PIXELS = 256  # of a camera's row
FOV = math.radians(130)


class InMujoco:
    """Args: robot: the description's. steps_per_second: of the policy."""

    def __init__(self, robot, steps_per_second):
        self.robot, self.seconds = robot, 1 / steps_per_second

    def begin(self, episode):
        """Makes a model with the walls as boxes, 1 m high, and the robot at the start. From then on
        only its wheels' motors move it.
        """
        robot, n = self.robot, self.robot["n_rays"]
        walls = []
        for k, (a, b) in enumerate(episode.walls.astype(float)):
            (x, y), (dx, dy) = (a + b) / 2, b - a
            shade = 0.45 + 0.1 * (k * 7 % 5)
            walls.append(
                f'<geom type="box" pos="{x} {y} .5" size="{max(math.hypot(dx, dy) / 2, 1e-3)} .002 '
                f'.5" euler="0 0 {math.degrees(math.atan2(dy, dx))}" friction=".3" '
                f'rgba="{shade} {shade} {0.9 * shade} 1"/>'
            )
        angles = 2 * np.pi * np.arange(n) / n
        site = '<site name="ray{}" pos="0 0 {}" zaxis="{} {} 0" rgba="0 0 0 0"/>'
        rays = [site.format(k, HEIGHT, math.cos(a), math.sin(a)) for k, a in enumerate(angles)]
        x, y, angle = episode.start.tolist()
        mx, my = episode.walls.reshape(-1, 2).mean(0)
        text = MODEL.format(
            **dict(walls="\n".join(walls), x=x, y=y, angle=math.degrees(angle), lidar=HEIGHT),
            **dict(sites="\n".join(rays), wheel=WHEEL, half=TRACK / 2, radius=robot["radius"]),
            sensors="".join(f'<rangefinder site="ray{k}"/>' for k in range(n)),
            middle=f"{mx} {my}",
            fovy=math.degrees(2 * math.atan(math.tan(FOV / 2) * 8 / PIXELS)),
        )
        self.model = mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(self.model)
        self.body = self.model.geom("body").id
        self.n_substeps = round(self.seconds / self.model.opt.timestep)
        self.command = np.zeros(2)
        self._read()
        self.view = None
        self.sense = self._rgb if robot["sensor"] == "rgb" else self._ranges

    def _read(self):
        """Computes the sensors, which are left out in between."""
        self.model.opt.disableflags = 0
        mujoco.mj_forward(self.model, self.data)
        self.model.opt.disableflags = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)

    def _ranges(self):
        ranges = self.data.sensordata.copy()  # -1: no return
        return np.where((ranges < 0) | (ranges > self.robot["range_max"]), np.inf, ranges)

    def _rgb(self):
        """Returns the middle row of a camera's image as 64 pixels in linear light, (3, 64)."""
        if self.view is None:
            self.view = mujoco.Renderer(self.model, 8, PIXELS)
        self.view.update_scene(self.data, "eye")
        row = (self.view.render()[4] / 255.0) ** 2.2
        return row.reshape(PIXELS // 4, 4, 3).mean(1).T

    def pose(self):
        """Returns (x, y, radians)."""
        w, x, y, z = self.data.qpos[3:7]
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return np.array([*self.data.qpos[:2], yaw])

    def twist(self):
        """Returns (m/s ahead, rad/s)."""
        yaw, (vx, vy) = self.pose()[2], self.data.qvel[:2]
        return np.array([math.cos(yaw) * vx + math.sin(yaw) * vy, self.data.qvel[5]])

    def drive(self, command):
        """Drives for one step of the policy: the motors turn the wheels at speeds that follow the
        command with the robot's accelerations, as its firmware does. Returns whether it touched a
        wall.
        """
        robot, touches = self.robot, False
        limits = np.array([robot["speed"], robot["turn_rate"]])
        change = np.array([robot["accel"], robot["turn_accel"]]) * self.model.opt.timestep
        command = np.clip(command, -limits, limits)
        for _ in range(self.n_substeps):
            self.command += np.clip(command - self.command, -change, change)
            speed, aside = self.command[0], self.command[1] * TRACK / 2
            self.data.ctrl[:] = (speed - aside) / WHEEL, (speed + aside) / WHEEL
            mujoco.mj_step(self.model, self.data)
            pairs = self.data.contact.geom
            touches |= bool((pairs == self.body).any()) if len(pairs) else False
        self._read()
        return touches
