"""A bag of ROS 2 against its log: ros2.py VPD LOG. Every number and time, by two readers of others."""

import pathlib
import subprocess
import sys
import tempfile

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from mcap_ros2.decoder import DecoderFactory as Ros2
from rosbags.highlevel import AnyReader

vpd, log = sys.argv[1], sys.argv[2]
bag = pathlib.Path(tempfile.mkdtemp()) / "bag.mcap"
subprocess.run([vpd, "export", log, "--ros2", "-o", bag], check=True, stdout=subprocess.DEVNULL)


def turn(found):
    return [found.w, found.x, found.y, found.z]


def vector(found):
    return [found.x, found.y, found.z]


def time(stamp):
    nanoseconds = stamp.nanosec if hasattr(stamp, "nanosec") else stamp.nanosecond
    return stamp.sec * 1_000_000_000 + nanoseconds


def of_log():
    wanted = {topic: [] for topic in ("/imu", "/attitude", "/tf", "/energy/error", "/orthogonality/error", "/momentum/drift")}
    with open(log, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        for _, channel, message, found in reader.iter_decoded_messages():
            at = message.log_time
            if channel.topic == "/state":
                wanted["/imu"].append((at, list(found.quaternion), list(found.angular_velocity)))
                wanted["/attitude"].append((at, list(found.quaternion)))
            elif channel.topic == "/tf":
                frames = found.transforms
                wanted["/tf"].append((at, [(f.parent_frame_id, f.child_frame_id, vector(f.translation), turn(f.rotation)) for f in frames]))
            elif channel.topic == "/energy":
                wanted["/energy/error"].append((at, found.error))
            elif channel.topic == "/orthogonality":
                wanted["/orthogonality/error"].append((at, found.error))
            elif channel.topic == "/momentum" and found.HasField("drift"):
                wanted["/momentum/drift"].append((at, found.drift))
    return wanted


def value(topic, at, found):
    if topic == "/imu":
        assert time(found.header.stamp) == at and found.header.frame_id == "body"
        assert list(found.linear_acceleration_covariance)[0] == -1.0
        return at, turn(found.orientation), vector(found.angular_velocity)
    if topic == "/attitude":
        assert time(found.header.stamp) == at and found.header.frame_id == "space"
        return at, turn(found.quaternion)
    if topic == "/tf":
        assert all(time(frame.header.stamp) == at for frame in found.transforms)
        return at, [
            (f.header.frame_id, f.child_frame_id, vector(f.transform.translation), turn(f.transform.rotation))
            for f in found.transforms
        ]
    return at, found.data


wanted = of_log()
by_mcap = {topic: [] for topic in wanted}
with open(bag, "rb") as file:
    reader = make_reader(file, decoder_factories=[Ros2()], validate_crcs=True)
    assert reader.get_header().profile == "ros2"
    for _, channel, message, found in reader.iter_decoded_messages():
        by_mcap[channel.topic].append(value(channel.topic, message.log_time, found))
assert by_mcap == wanted, "mcap-ros2-support reads other numbers"

by_rosbags = {topic: [] for topic in wanted}
with AnyReader([bag]) as reader:
    for connection, at, data in reader.messages():
        found = reader.deserialize(data, connection.msgtype)
        by_rosbags[connection.topic].append(value(connection.topic, at, found))
assert by_rosbags == wanted, "rosbags reads other numbers"
print(f"{sum(map(len, wanted.values()))} messages of {len(wanted)} topics, the same by mcap-ros2-support and rosbags")
