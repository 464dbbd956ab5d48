"""A node for a robot: LaserScan and Odometry in, velocity commands out.

    python robot_node.py robot.onnx --goal 3.0 -1.5 --messages messages.jsonl    # without ROS
    python robot_node.py robot.onnx --goal 3.0 -1.5                              # with rclpy

Messages have the fields of ROS's, as objects or as dicts, such as those that IR-SIM gives. With
rclpy it subscribes to /scan and /odom and publishes /cmd_vel, as a TurtleBot 4 has them. A robot
that hears nothing for half a second stops, and so does one at its goal.
"""

import argparse
import json
import math
import sys

import numpy as np
from episodes import to_robot
from robot_policy import RobotPolicy

SILENCE = 0.5  # seconds after which a message is too old


class RobotNode:
    """Turns the last messages into a command at each tick of the policy's clock.

    Args:
        policy: a RobotPolicy of a lidar.
        goal: (x, y) in metres, in the frame of the odometry.
        lidar_yaw: radians by which the lidar is turned on the robot.
    """

    def __init__(self, policy, goal, lidar_yaw=0.0):
        if policy.scan is None:
            raise ValueError("the policy has no scan; a node needs one of a lidar")
        self.policy, self.goal, self.yaw = policy, np.asarray(goal, float), lidar_yaw
        self.scan = self.odometry = None
        policy.begin()

    def on_scan(self, message):
        """Takes a sensor_msgs/LaserScan."""
        get = reader(message)
        ranges = np.array(get("ranges"), float)
        too_far, too_near = ranges > get("range_max"), ranges < get("range_min")
        # some drivers write 0 for a ray without a return
        ranges = np.where(too_near, np.where(ranges > 0, 0.0, np.inf), ranges)
        ranges = np.where(too_far | np.isnan(ranges), np.inf, ranges)
        angles = get("angle_min") + self.yaw, get("angle_increment")
        self.scan = stamp(get("header")), self.policy.resampled(ranges, *angles)

    def on_odometry(self, message):
        """Takes a nav_msgs/Odometry."""
        get = reader(message)
        place, turn = (get(f"pose.pose.{name}") for name in ("position", "orientation"))
        x, y, z, w = (reader(turn)(name) for name in "xyzw")
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        pose = np.array([reader(place)("x"), reader(place)("y"), yaw])
        twist = np.array([get("twist.twist.linear.x"), get("twist.twist.angular.z")])
        self.odometry = stamp(get("header")), pose, twist

    def tick(self, now):
        """Returns the command (m/s ahead, rad/s to the left) at a time in seconds."""
        if self.scan is None or self.odometry is None:
            return np.zeros(2)
        at, pose, twist = self.odometry
        goal = to_robot(pose, self.goal)
        is_old = now - min(at, self.scan[0]) > SILENCE
        if is_old or np.hypot(*goal) <= self.policy.about["reach"]:
            return np.zeros(2)
        return self.policy.act(self.scan[1], twist, goal)


def reader(message):
    """Returns a function that reads a dotted field of a message."""

    def get(path):
        value = message
        for name in path.split("."):
            value = value[name] if isinstance(value, dict) else getattr(value, name)
        return value

    return get


def stamp(header):
    """Returns a header's time in seconds, of ROS or of IR-SIM."""
    at = reader(header)("stamp")
    if isinstance(at, (int, float)):
        return float(at)
    get = reader(at)
    return get("sec") + 1e-9 * get("nanosec")


def replay(node, lines):
    """Yields (seconds, command) of recorded messages, JSON lines with `scan` and `odometry`."""
    for line in lines:
        messages = json.loads(line)
        node.on_scan(messages["scan"])
        node.on_odometry(messages["odometry"])
        now = max(node.scan[0], node.odometry[0])
        yield now, node.tick(now)


def spin(node):
    """Runs a node with ROS 2."""
    import rclpy
    from geometry_msgs.msg import TwistStamped
    from nav_msgs.msg import Odometry
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import LaserScan

    rclpy.init()
    ros = rclpy.create_node("megastep_policy")
    commands = ros.create_publisher(TwistStamped, "cmd_vel", 10)
    ros.create_subscription(LaserScan, "scan", node.on_scan, qos_profile_sensor_data)
    ros.create_subscription(Odometry, "odom", node.on_odometry, qos_profile_sensor_data)

    def send():
        message, now = TwistStamped(), ros.get_clock().now()
        speed, turn = node.tick(now.nanoseconds * 1e-9)
        message.header.stamp = now.to_msg()
        message.twist.linear.x, message.twist.angular.z = float(speed), float(turn)
        commands.publish(message)

    ros.create_timer(1 / node.policy.about["steps_per_second"], send)
    rclpy.spin(ros)


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("policy")
    parser.add_argument("--goal", type=float, nargs=2, required=True)
    parser.add_argument("--lidar-yaw", type=float, default=0.0)
    parser.add_argument("--messages")
    words = parser.parse_args()
    try:
        node = RobotNode(RobotPolicy(words.policy), words.goal, words.lidar_yaw)
        if words.messages is None:
            spin(node)
        else:
            with open(words.messages) as file:
                for now, (speed, turn) in replay(node, file):
                    print(f"{now:.1f} s: {speed:+.2f} m/s, {turn:+.2f} rad/s")
    except ImportError as error:
        sys.exit(f"robot_node.py: ROS 2 is not installed ({error.name} is missing); use --messages")
    except (ValueError, OSError) as error:
        print(f"robot_node.py: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
