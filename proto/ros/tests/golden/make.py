"""Writes the golden messages of this folder with rosbags (PyPI, 0.11.9), an independent implementation of CDR.

python -m venv venv && venv/bin/pip install rosbags==0.11.9 && venv/bin/python make.py
The values are arbitrary; golden.rs has the same ones.
"""

from pathlib import Path

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

store = get_typestore(Stores.ROS2_JAZZY)
store.register(get_types_from_msg(
    "builtin_interfaces/Time stamp\nuint8[1206] data", "velodyne_msgs/msg/VelodynePacket"))
store.register(get_types_from_msg(
    "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets", "velodyne_msgs/msg/VelodyneScan"))
T = store.types
SEC, NANOSEC = 1_700_000_000, 250_000_000


def write(name, message, little_endian=True):
    bytes_ = store.serialize_cdr(message, message.__msgtype__, little_endian=little_endian)
    Path(__file__).with_name(name).write_bytes(bytes_)


def header(frame, nanosec=NANOSEC):
    stamp = T["builtin_interfaces/msg/Time"](sec=SEC, nanosec=nanosec)
    return T["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def cloud(frame, dtype, points, height=1, row_padding=0):
    array = np.zeros(len(points), dtype)
    for index, point in enumerate(points):
        array[index] = point
    width = len(points) // height
    rows = [array[i * width:(i + 1) * width].tobytes() + bytes(row_padding) for i in range(height)]
    fields = [
        T["sensor_msgs/msg/PointField"](
            name=n, offset=dtype.fields[n][1], datatype=DATATYPES[dtype.fields[n][0].str[1:]], count=1)
        for n in dtype.names
    ]
    return T["sensor_msgs/msg/PointCloud2"](
        header=header(frame), height=height, width=width, fields=fields,
        is_bigendian=dtype.fields["x"][0].str[0] == ">", point_step=dtype.itemsize,
        row_step=width * dtype.itemsize + row_padding,
        data=np.frombuffer(b"".join(rows), np.uint8), is_dense=False)


nan = float("nan")
# velodyne_pointcloud: seconds after the header's stamp.
write("velodyne.cdr", cloud("velodyne", np.dtype(
    {"names": ["x", "y", "z", "intensity", "ring", "time"], "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"],
     "offsets": [0, 4, 8, 12, 16, 18], "itemsize": 22}),
    [(10, 0, -2, 51, 0, -0.1), (nan, nan, nan, 0, 1, -0.05), (12, 1, 2, 255, 15, 0)]))
# Ouster: organised, rows padded, rings from the top, ns after the header's stamp, no return as three zeros.
write("ouster.cdr", cloud("os_lidar", np.dtype(
    {"names": ["x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient", "range"],
     "formats": ["<f4", "<f4", "<f4", "<f4", "<u4", "<u2", "<u2", "<u2", "<u4"],
     "offsets": [0, 4, 8, 16, 20, 24, 26, 28, 32], "itemsize": 48}),
    [(5, 0, 1, 0.5, 0, 7, 0, 0, 1), (0, 0, 0, 0, 100_000_000, 0, 0, 0, 0),
     (5, 0, -1, 0.25, 0, 7, 63, 0, 1), (6, 0, -1, 1, 100_000_000, 7, 63, 0, 1)], height=2, row_padding=8))
# Hesai: float64 seconds since the epoch; the message big endian, its points too.
write("hesai_big_endian.cdr", cloud("hesai_lidar", np.dtype(
    {"names": ["x", "y", "z", "intensity", "timestamp", "ring"], "formats": [">f4", ">f4", ">f4", ">f4", ">f8", ">u2"],
     "offsets": [0, 4, 8, 12, 16, 24], "itemsize": 26}),
    [(1, 2, 3, 0, SEC + 0.25, 1), (3, 2, -1, 100, SEC + 0.375, 2)]), little_endian=False)
# Livox: float64 ns since the epoch, float64 positions for good measure.
write("livox.cdr", cloud("livox_frame", np.dtype(
    {"names": ["x", "y", "z", "intensity", "tag", "line", "timestamp"],
     "formats": ["<f8", "<f8", "<f8", "<f4", "<u1", "<u1", "<f8"],
    "offsets": [0, 8, 16, 24, 28, 29, 30], "itemsize": 38}),
    [(1, 2, 3, 255, 0, 1, (SEC + 0.25) * 1e9), (3, 2, 1, 0, 0, 0, (SEC + 0.3125) * 1e9)]))
# nebula, PointXYZIRCAEDT.
write("nebula.cdr", cloud("lidar_top", np.dtype(
    {"names": ["x", "y", "z", "intensity", "return_type", "channel", "azimuth", "elevation", "distance", "time_stamp"],
     "formats": ["<f4", "<f4", "<f4", "<u1", "<u1", "<u2", "<f4", "<f4", "<f4", "<u4"],
     "offsets": [0, 4, 8, 12, 13, 14, 16, 20, 24, 28], "itemsize": 32}),
    [(1, 0, -1, 51, 1, 0, 0, 0, 1, 0), (1, 0, 1, 255, 1, 127, 0, 0, 1, 99_000_000)]))
vector, quaternion = T["geometry_msgs/msg/Vector3"], T["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.6, w=0.8)
pose = T["geometry_msgs/msg/Pose"](position=T["geometry_msgs/msg/Point"](x=1.0, y=2.0, z=3.0), orientation=quaternion)
twist = T["geometry_msgs/msg/Twist"](linear=vector(x=15.0, y=0.5, z=0.0), angular=vector(x=0.0, y=0.0, z=0.25))
write("odometry.cdr", T["nav_msgs/msg/Odometry"](
    header=header("odom"), child_frame_id="base_link",
    pose=T["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.arange(36.0)),
    twist=T["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.arange(36.0))))
write("pose_stamped.cdr", T["geometry_msgs/msg/PoseStamped"](header=header("map"), pose=pose))
transform = T["geometry_msgs/msg/Transform"](translation=vector(x=1.0, y=2.0, z=3.0), rotation=quaternion)
stamped = T["geometry_msgs/msg/TransformStamped"]
write("tf_message.cdr", T["tf2_msgs/msg/TFMessage"](transforms=[
    stamped(header=header("map"), child_frame_id="odom", transform=transform),
    stamped(header=header("odom", 0), child_frame_id="base_link", transform=transform)]))
write("pose_array.cdr", T["geometry_msgs/msg/PoseArray"](header=header("car/base_link"), poses=[pose, pose]))
stamped_pose = T["geometry_msgs/msg/PoseStamped"]
write("path.cdr", T["nav_msgs/msg/Path"](
    header=header("map"), poses=[stamped_pose(header=header("map"), pose=pose)] * 2))
point, time = T["geometry_msgs/msg/Point"], T["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
image = T["sensor_msgs/msg/CompressedImage"](
    header=T["std_msgs/msg/Header"](stamp=time, frame_id=""), format="", data=np.zeros(0, np.uint8))
unturned = T["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)


def lines(name, action, width, rgba, points):
    return T["visualization_msgs/msg/Marker"](
        header=header("car/base_link"), ns=name, id=0, type=5, action=action,
        pose=T["geometry_msgs/msg/Pose"](position=point(x=0.0, y=0.0, z=0.0), orientation=unturned),
        scale=vector(x=width, y=0.0, z=0.0), color=T["std_msgs/msg/ColorRGBA"](*rgba),
        lifetime=T["builtin_interfaces/msg/Duration"](sec=1, nanosec=500_000_000), frame_locked=True,
        points=[point(*p) for p in points], colors=[], texture_resource="", texture=image, uv_coordinates=[], text="",
        mesh_resource="", mesh_file=T["visualization_msgs/msg/MeshFile"](filename="", data=np.zeros(0, np.uint8)),
        mesh_use_embedded_materials=False)


write("marker_array.cdr", T["visualization_msgs/msg/MarkerArray"](markers=[
    lines("links", 0, 0.1, (1.0, 0.5, 0.25, 1.0), [(1.0, 2.0, 0.0), (3.0, -4.0, 0.5)]),
    lines("radii", 2, 0.05, (0.0, 0.0, 1.0, 0.5), [])]))
value, status = T["diagnostic_msgs/msg/KeyValue"], T["diagnostic_msgs/msg/DiagnosticStatus"]
write("diagnostic_array.cdr", T["diagnostic_msgs/msg/DiagnosticArray"](header=header(""), status=[
    status(level=2, name="clearway: car", message="no packets from top for 3.1 s", hardware_id="car",
           values=[value(key="loss", value="0.125"), value(key="maps", value="12")]),
    status(level=0, name="clearway: bus", message="", hardware_id="bus", values=[])]))
packets = [T["velodyne_msgs/msg/VelodynePacket"](
    stamp=T["builtin_interfaces/msg/Time"](sec=SEC, nanosec=i), data=np.full(1206, i, np.uint8)) for i in range(3)]
write("velodyne_scan.cdr", T["velodyne_msgs/msg/VelodyneScan"](header=header("velodyne"), packets=packets))
