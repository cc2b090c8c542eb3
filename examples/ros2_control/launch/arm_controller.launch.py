"""Loads and activates the controller in a running controller manager."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """The spawner of the controller, with the parameters of this package or of a file of yours."""
    own = PathJoinSubstitution([FindPackageShare("arm_controller"), "config", "arm_controller.yaml"])
    spawner = Node(
        package="controller_manager",
        executable="spawner",
        arguments=["arm_controller", "--param-file", LaunchConfiguration("parameters")],
    )
    return LaunchDescription([DeclareLaunchArgument("parameters", default_value=own), spawner])
