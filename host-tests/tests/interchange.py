"""Reads what `lineslam` wrote with readers that know nothing of it, and holds them against each other.

    interchange.py FOLDER

FOLDER holds run.mcap, map.dxf, map.pgm, map.yaml, map.csv, trajectory.csv, trajectory_final.tum and facts.json.
"""

import csv
import json
import math
import sys
from pathlib import Path

import ezdxf
import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability

TYPES = {
    "/scan": "sensor_msgs/msg/LaserScan",
    "/joint_states": "sensor_msgs/msg/JointState",
    "/odom": "nav_msgs/msg/Odometry",
    "/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/path": "nav_msgs/msg/Path",
    "/map": "nav_msgs/msg/OccupancyGrid",
    "/segments": "visualization_msgs/msg/MarkerArray",
}
KEPT = {"/tf_static", "/path", "/map", "/segments"}
LEAST_UNIT = 1e-6


def ns(stamp):
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def matrix(translation, rotation):
    """The 4 x 4 matrix of a transform or pose."""
    x, y, z, w = rotation.x, rotation.y, rotation.z, rotation.w
    assert abs(x * x + y * y + z * z + w * w - 1) < 1e-9
    m = np.eye(4)
    m[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    m[:3, 3] = translation.x, translation.y, translation.z
    return m


def planar(m):
    return m[0, 3], m[1, 3], math.atan2(m[1, 0], m[0, 0])


def near(a, b, tolerance=LEAST_UNIT):
    assert np.allclose(a, b, rtol=0, atol=tolerance), f"{a} is not {b}"


def read_with_mcap(path):
    """Messages by topic, from MCAP's own reader."""
    messages = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
        counts = summary.statistics.channel_message_counts
        for channel in summary.channels.values():
            schema = summary.schemas[channel.schema_id]
            assert (channel.message_encoding, schema.encoding) == ("cdr", "ros2msg")
            assert schema.name == TYPES[channel.topic], channel.topic
            messages[channel.topic] = []
        last = 0
        for _, channel, message, decoded in reader.iter_decoded_messages():
            assert message.log_time == message.publish_time >= last
            last = message.log_time
            messages[channel.topic].append(decoded)
        by_topic = {summary.channels[id].topic: count for id, count in counts.items()}
        assert by_topic == {topic: len(some) for topic, some in messages.items()}
    return messages


def read_with_rosbags(path):
    """The same from rosbags, which parses the definitions in the file itself."""
    messages = {}
    with AnyReader([path]) as reader:
        for connection in reader.connections:
            assert connection.msgtype == TYPES[connection.topic]
            (profile,) = connection.ext.offered_qos_profiles
            kept = profile.durability == QosDurability.TRANSIENT_LOCAL
            assert kept == (connection.topic in KEPT), connection.topic
            messages[connection.topic] = []
        for connection, stamp, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            if hasattr(message, "header"):
                assert ns(message.header.stamp) == stamp
            messages[connection.topic].append(message)
    return messages


def check_counts(messages, facts):
    scans = facts["scans"]
    counts = {topic: len(some) for topic, some in messages.items()}
    assert counts == {
        "/scan": scans,
        "/joint_states": facts["wheel_readings"],
        "/odom": scans,
        "/pose": scans,
        "/tf": scans,
        "/tf_static": 1,
        "/path": 1,
        "/map": 1,
        "/segments": 1,
    }, counts


def check_scans(messages, others, facts):
    limits = facts["min_mm"], facts["max_mm"]
    for scan, other, logged in zip(messages["/scan"], others["/scan"], facts["logged"], strict=True):
        assert scan.header.frame_id == "laser"
        ranges = np.asarray(scan.ranges, np.float64)
        assert np.array_equal(ranges, np.asarray(other.ranges, np.float64), equal_nan=True)
        near(scan.range_min, limits[0] / 1000)
        near(scan.range_max, (limits[1] + 1) / 1000)
        near(scan.angle_max, scan.angle_min + (len(ranges) - 1) * scan.angle_increment, 1e-4)
        middle = ns(scan.header.stamp) + 0.5e9 * (len(ranges) - 1) * float(scan.time_increment)
        near(middle / 1000, logged["stamp_us"], 1.0)
        values = np.array(logged["ranges_mm"])
        nothing = np.isin(values, facts["no_echo_mm"]) | (values > limits[1])
        bad = ~nothing & (values < limits[0])
        assert np.array_equal(np.isposinf(ranges), nothing) and np.array_equal(np.isnan(ranges), bad)
        measured = ~nothing & ~bad
        assert np.array_equal(np.round(ranges[measured] * 1000), values[measured])


def check_wheels(messages, facts):
    for joints, expected in zip(messages["/joint_states"], facts["wheel_angles"], strict=True):
        assert list(joints.name) == ["wheel_left_joint", "wheel_right_joint"]
        near(joints.position, expected, 1e-9)


def check_poses(messages, folder):
    """The chain of transforms is the pose, and the covariance stands where it belongs."""
    rows = list(csv.DictReader((folder / "trajectory.csv").open()))
    axes = {"x": 0, "y": 1, "t": 5}
    for row, tf, pose, odom in zip(rows, messages["/tf"], messages["/pose"], messages["/odom"], strict=True):
        pairs = [(t.header.frame_id, t.child_frame_id) for t in tf.transforms]
        assert pairs == [("map", "odom"), ("odom", "base_link")]
        map_from_odom, odom_from_base = (
            matrix(t.transform.translation, t.transform.rotation) for t in tf.transforms
        )
        expected = [float(row[key]) for key in ("x_m", "y_m", "theta_rad")]
        near(planar(map_from_odom @ odom_from_base), expected)
        near(planar(matrix(pose.pose.pose.position, pose.pose.pose.orientation)), expected)
        near(matrix(odom.pose.pose.position, odom.pose.pose.orientation), odom_from_base, 1e-9)
        assert (pose.header.frame_id, odom.header.frame_id, odom.child_frame_id) == ("map", "odom", "base_link")
        near(ns(pose.header.stamp) / 1e9, float(row["stamp_s"]), 1e-6)
        covariance = np.zeros((6, 6))
        for key, value in row.items():
            if key.startswith("cov_"):
                a, b = (axes[axis] for axis in key[4:6])
                covariance[a, b] = covariance[b, a] = float(value)
        # The message widens what the file prints with the digits of single precision.
        near(np.reshape(pose.pose.covariance, (6, 6)), covariance, 1e-9 + 1e-7 * np.abs(covariance).max())
    (path,) = messages["/path"]
    final = np.loadtxt(folder / "trajectory_final.tum")
    near([ns(p.header.stamp) / 1e9 for p in path.poses], final[:, 0])
    near([(p.pose.position.x, p.pose.position.y) for p in path.poses], final[:, 1:3], 2e-6)


def check_map(messages, folder):
    """The grid is that of map.pgm, as map_server would read it in trinary mode."""
    (grid,) = messages["/map"]
    yaml = dict(line.split(": ", 1) for line in (folder / "map.yaml").read_text().splitlines())
    assert yaml["mode"] == "trinary" and yaml["negate"] == "0"
    near(grid.info.resolution, float(yaml["resolution"]))
    near([grid.info.origin.position.x, grid.info.origin.position.y, 0], json.loads(yaml["origin"]))
    pgm = (folder / "map.pgm").read_bytes()
    magic, width, height, most = pgm.split(maxsplit=4)[:4]
    width, height = int(width), int(height)
    assert (magic, most, grid.info.width, grid.info.height) == (b"P5", b"255", width, height)
    dark = 1 - np.frombuffer(pgm[-width * height :], np.uint8).reshape(height, width)[::-1] / 255
    trinary = np.full(dark.shape, -1)
    trinary[dark > float(yaml["occupied_thresh"])] = 100
    trinary[dark < float(yaml["free_thresh"])] = 0
    cells = np.reshape(grid.data, (height, width)).astype(int)
    assert np.array_equal(cells, trinary)
    assert {-1, 0, 100} == set(np.unique(cells))


def distances(points, segments):
    """From each point to the nearest segment."""
    a, b = segments[:, :2], segments[:, 2:]
    along = b - a
    share = np.clip(np.einsum("nij,ij->ni", points[:, None] - a, along) / (along**2).sum(1), 0, 1)
    foot = a + share[..., None] * along
    return np.hypot(*np.moveaxis(points[:, None] - foot, 2, 0)).min(1)


def check_segments(messages, folder, facts):
    """Markers and drawing are the segments of map.csv, and the beams, laid by the transforms alone, end on them."""
    rows = np.loadtxt(folder / "map.csv", delimiter=",", skiprows=1, ndmin=2)[:, :4]
    (markers,) = messages["/segments"]
    lines = []
    for marker in markers.markers:
        assert (marker.type, marker.action, marker.header.frame_id) == (5, 0, "map")
        corners = [(p.x, p.y) for p in marker.points]
        lines += [corners[k] + corners[k + 1] for k in range(0, len(corners), 2)]
    near(sorted(lines), sorted(map(tuple, rows.tolist())), 1e-5)
    assert markers.markers[0].color.a == 1.0

    drawing = ezdxf.readfile(folder / "map.dxf")
    assert drawing.header["$INSUNITS"] == 6
    assert not drawing.audit().has_errors
    space = drawing.modelspace()
    drawn = [(e.dxf.start.x, e.dxf.start.y, e.dxf.end.x, e.dxf.end.y) for e in space.query("LINE")]
    near(sorted(drawn), sorted(map(tuple, rows.tolist())), 1e-5)
    layers = {name: 0 for name in ("WALLS_SURE", "WALLS", "WALLS_TENTATIVE")}
    for line in space.query("LINE"):
        layers[line.dxf.layer] += 1
    assert list(layers.values()) == facts["segments_by_hits"], layers
    (path,) = space.query("LWPOLYLINE")
    assert path.dxf.layer == "PATH" and len(path) > 10

    (static,) = messages["/tf_static"]
    (mounted,) = static.transforms
    assert (mounted.header.frame_id, mounted.child_frame_id) == ("base_link", "laser")
    base_from_laser = matrix(mounted.transform.translation, mounted.transform.rotation)
    assert (base_from_laser[2, 2] < 0) == facts["upside_down"]
    off = []
    for scan, tf in list(zip(messages["/scan"], messages["/tf"]))[::20]:
        map_from_odom, odom_from_base = (
            matrix(t.transform.translation, t.transform.rotation) for t in tf.transforms
        )
        ranges = np.asarray(scan.ranges, float)
        bearings = scan.angle_min + scan.angle_increment * np.arange(len(ranges))
        good = np.isfinite(ranges)
        ranges, bearings = ranges[good], bearings[good]
        flat = np.zeros_like(ranges)
        in_laser = np.array([ranges * np.cos(bearings), ranges * np.sin(bearings), flat, flat + 1])
        in_map = (map_from_odom @ odom_from_base @ base_from_laser @ in_laser)[:2].T
        off.append(distances(in_map, rows))
    off = np.concatenate(off)
    print(f"beams end {np.median(off):.3f} m from the segments, 80 % within {np.quantile(off, 0.8):.3f} m")
    # Head down is the same drive with its beams in the other order: what was taken first counts as taken last, and de-skew errs.
    most = (0.06, 0.16) if facts["upside_down"] else (0.03, 0.1)
    assert np.median(off) < most[0] and np.quantile(off, 0.8) < most[1]


def main():
    folder = Path(sys.argv[1])
    facts = json.loads((folder / "facts.json").read_text())
    messages = read_with_rosbags(folder / "run.mcap")
    others = read_with_mcap(folder / "run.mcap")
    check_counts(messages, facts)
    check_counts(others, facts)
    check_scans(messages, others, facts)
    check_wheels(others, facts)
    check_poses(messages, folder)
    check_poses(others, folder)
    check_map(messages, folder)
    check_map(others, folder)
    check_segments(messages, folder, facts)
    check_segments(others, folder, facts)


main()
