"""write_ros1.py LOG.jsonl OUT.bag none|bz2|lz4: a drive in JSON lines as a ROS 1 bag, by the package rosbags."""

import json
import math
import sys
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

log, bag, compression = sys.argv[1:]
store = get_typestore(Stores.ROS1_NOETIC)
types = store.types
Time, Header = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
LaserScan, JointState = types["sensor_msgs/msg/LaserScan"], types["sensor_msgs/msg/JointState"]


def header(ns, frame):
    return Header(seq=0, stamp=Time(sec=ns // 10**9, nanosec=ns % 10**9), frame_id=frame)


lines = [json.loads(line) for line in open(log)]
sensor, wheels = lines[0]["sensor"], lines[0]["wheels"]
increment = np.float32(math.radians(sensor["step_deg"]))
between_beams_s = np.float32(sensor["revolution_s"] * sensor["step_deg"] / 360)
span = 1 << wheels["counter_bits"]
angles, before = [0.0, 0.0], None

writer = Writer(Path(bag))
if compression != "none":
    writer.set_compression(Writer.CompressionFormat[compression.upper()])
with writer:
    scans = writer.add_connection("/scan", LaserScan.__msgtype__, typestore=store)
    joints = writer.add_connection("/joint_states", JointState.__msgtype__, typestore=store)
    for line in lines[1:]:
        ns = line["t_us"] * 1000
        if "ticks" in line:
            if before is not None:
                for side in (0, 1):
                    moved = (line["ticks"][side] - before[side] + span // 2) % span - span // 2
                    angles[side] += moved * 2 * math.pi / wheels["ticks_per_turn"]
            before = line["ticks"]
            empty = np.zeros(0)
            message = JointState(
                header=header(ns, ""),
                name=["wheel_left_joint", "wheel_right_joint"],
                position=np.array(angles),
                velocity=empty,
                effort=empty,
            )
            writer.write(joints, ns, store.serialize_ros1(message, JointState.__msgtype__))
        if "ranges_mm" in line:
            mm = np.array(line["ranges_mm"])
            # As REP 117 has it; these are the codes of a URG for "nothing in range".
            metres = np.where(mm >= 20, mm / 1000, np.where((mm == 0) | (mm == 6), np.inf, np.nan))
            # A scan bears the stamp of its first beam.
            first = ns - int(round(float(between_beams_s) * (len(mm) - 1) / 2 * 1e9))
            message = LaserScan(
                header=header(first, "laser"),
                angle_min=np.float32(math.radians(sensor["first_bearing_deg"])),
                angle_max=np.float32(0),
                angle_increment=increment,
                time_increment=between_beams_s,
                scan_time=np.float32(sensor["revolution_s"]),
                range_min=np.float32(sensor["min_range_m"]),
                range_max=np.float32(sensor["max_range_m"]),
                ranges=metres.astype(np.float32),
                intensities=np.zeros(0, np.float32),
            )
            writer.write(scans, ns, store.serialize_ros1(message, LaserScan.__msgtype__))
