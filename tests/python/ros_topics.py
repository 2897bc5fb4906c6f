"""A subscriber that uses nothing of Clearway, only rmw_zenoh's key space and ROS 2's messages. It finds the topics by
their liveliness tokens, subscribes late, twice, and prints the topics and the messages as one JSON object.

Usage: ros_topics.py ENDPOINT DOMAIN
"""

import json
import queue
import sys

import zenoh
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)


def ros_type(dds_name):
    package, message = dds_name.split("::msg::dds_::")
    return f"{package}/msg/{message.removesuffix('_')}"


def publishers(session, domain):
    """The topics, each with the fields of its liveliness token."""
    found = {}
    for reply in session.liveliness().get(f"@ros2_lv/{domain}/**"):
        parts = str(reply.ok.key_expr).split("/")
        if parts[5] == "MP":
            topic, dds_name, type_hash, qos = parts[9:]
            found[topic.replace("%", "/")] = {"node": parts[8], "type": dds_name, "hash": type_hash, "qos": qos}
        else:
            assert parts[5] == "NN" and parts[3] == parts[4], parts
    return found


def message(sample, name):
    payload = sample.payload.to_bytes()
    decoded = STORE.deserialize_cdr(payload, name)
    assert bytes(STORE.serialize_cdr(decoded, name)) == payload, f"{name}: other bytes when written again"
    attachment = sample.attachment.to_bytes()
    assert len(attachment) == 33 and attachment[16] == 16, attachment
    sequence, stamp = (int.from_bytes(attachment[i : i + 8], "little") for i in (0, 8))
    assert stamp > 1_600_000_000_000_000_000
    return decoded, sequence, attachment[17:].hex()


def of_header(header):
    return {"stamp_ns": header.stamp.sec * 10**9 + header.stamp.nanosec, "frame_id": header.frame_id}


def markers(decoded):
    """The ends of the lines of each marker, by the marker's name."""
    lines = {marker.ns: [[point.x, point.y] for point in marker.points] for marker in decoded.markers}
    return {**of_header(decoded.markers[0].header), "lines": lines}


def poses(decoded):
    return {**of_header(decoded.header), "poses": [[pose.position.x, pose.position.y] for pose in decoded.poses]}


def path(decoded):
    places = [stamped.pose.position for stamped in decoded.poses]
    return {**of_header(decoded.header), "poses": [[place.x, place.y] for place in places]}


def grid(decoded):
    position, orientation = decoded.info.origin.position, decoded.info.origin.orientation
    return {
        **of_header(decoded.header),
        "resolution": decoded.info.resolution,
        "size": [decoded.info.width, decoded.info.height],
        "origin": [position.x, position.y, orientation.z, orientation.w],
        "data": decoded.data.tolist(),
    }


def states(decoded):
    """The states by component; what changes from message to message is left out."""
    return {"states": {of.name: [of.level, of.hardware_id, [v.key for v in of.values]] for of in decoded.status}}


def cloud(decoded):
    return {**of_header(decoded.header), "points": decoded.width}


OF_TYPE = {
    "diagnostic_msgs/msg/DiagnosticArray": states,
    "sensor_msgs/msg/PointCloud2": cloud,
    "nav_msgs/msg/OccupancyGrid": grid,
    "visualization_msgs/msg/MarkerArray": markers,
    "geometry_msgs/msg/PoseArray": poses,
    "nav_msgs/msg/Path": path,
    "std_msgs/msg/Bool": lambda decoded: {"data": bool(decoded.data)},
}


def described(sample, name):
    decoded, sequence, gid = message(sample, name)
    return {"sequence": sequence, "gid": gid, **OF_TYPE[name](decoded)}


def main(endpoint, domain):
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        topics, messages = publishers(session, domain), {}
        # As rmw_zenoh subscribes to a latched, reliable topic: a message that was dropped on the way is asked for.
        latched = {
            "history": zenoh.ext.HistoryConfig(detect_late_publishers=True),
            "recovery": zenoh.ext.RecoveryConfig(heartbeat=True),
        }
        for topic, token in topics.items():
            name = ros_type(token["type"])
            assert token["hash"] == STORE.hash_rihs01(name), name
            key = f"{domain}/{topic.strip('/')}/{token['type']}/{token['hash']}"
            if name == "tf2_msgs/msg/TFMessage":
                samples = queue.Queue()
                subscriber = session.declare_subscriber(key, samples.put)
                transform = message(samples.get(timeout=60), name)[0].transforms[0]
                at, q = transform.transform.translation, transform.transform.rotation
                frames = [transform.header.frame_id, transform.child_frame_id]
                messages[topic] = {"frames": frames, "pose": [at.x, at.y, at.z, q.x, q.y, q.z, q.w]}
                subscriber.undeclare()
                continue
            if not token["qos"].startswith("1:1:"):
                # Not latched: the newest map is sent when the first subscriber comes.
                samples = queue.Queue()
                subscriber = session.declare_subscriber(key, samples.put)
                messages[topic] = described(samples.get(timeout=60), name)
                subscriber.undeclare()
                continue
            # Nothing is published after the second subscriber comes, so its map is from the cache.
            early, late = queue.Queue(), queue.Queue()
            first = zenoh.ext.declare_advanced_subscriber(session, key, early.put, **latched)
            messages[topic] = described(early.get(timeout=60), name)
            second = zenoh.ext.declare_advanced_subscriber(session, key, late.put, **latched)
            assert described(late.get(timeout=60), name) == messages[topic], topic
            first.undeclare()
            second.undeclare()
    print(json.dumps({"topics": topics, "messages": messages}))


main(*sys.argv[1:])
