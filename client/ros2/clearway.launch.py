"""RViz on the maps of a vehicle, and if wanted rmw_zenoh's router.

ros2 launch client/ros2/clearway.launch.py router:=true fixed_frame:=map
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

HERE = Path(__file__).resolve().parent


def generate_launch_description():
    return LaunchDescription([
        DeclareLaunchArgument("router", default_value="false", description="Start rmw_zenohd, rmw_zenoh's router"),
        DeclareLaunchArgument("fixed_frame", default_value="map", description="The frame of the grids"),
        Node(
            package="rmw_zenoh_cpp",
            executable="rmw_zenohd",
            condition=IfCondition(LaunchConfiguration("router")),
        ),
        Node(
            package="rviz2",
            executable="rviz2",
            arguments=["-d", str(HERE / "clearway.rviz"), "-f", LaunchConfiguration("fixed_frame")],
        ),
    ])
