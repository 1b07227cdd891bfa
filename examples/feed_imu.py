"""Feeds a flow with IMU samples from a program that knows Zenoh and nothing of caneflow.

pip install eclipse-zenoh msgpack
python feed_imu.py tcp/127.0.0.1:7447 cane/imu/imu 500
"""

import json
import sys
import time

import msgpack
import zenoh

endpoint, key, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
config = zenoh.Config()
config.insert_json5("mode", '"client"')  # a peer would connect and be heard by nobody
config.insert_json5("connect/endpoints", json.dumps([endpoint]))
with zenoh.open(config) as session:
    encoding = zenoh.Encoding("application/msgpack").with_schema("caneflow.Imu/1")
    publisher = session.declare_publisher(key, encoding=encoding)
    for seq in range(count):  # 0, 1, 2 ...: a gap is a loss
        sample = {
            "stamp": time.time_ns(),  # when it was measured, strictly increasing
            "seq": seq,
            "gyro": [0.0, 0.0, 0.1],  # rad/s, body
            "accel": [0.0, 0.0, 9.81],  # m/s^2, specific force
        }
        publisher.put(msgpack.packb(sample))
        time.sleep(0.01)
