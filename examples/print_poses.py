"""Prints the positions of a flow, from a program that knows Zenoh and nothing of caneflow.

pip install eclipse-zenoh msgpack
python print_poses.py tcp/127.0.0.1:7447 cane/fusion/pose 100
"""

import json
import sys

import msgpack
import zenoh

endpoint, key, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
config = zenoh.Config()
config.insert_json5("mode", '"client"')  # a peer would connect and hear nothing
config.insert_json5("connect/endpoints", json.dumps([endpoint]))
with zenoh.open(config) as session:
    poses = session.declare_subscriber(key)  # keep it: one without a name is gone at once
    for sample, _ in zip(poses, range(count), strict=False):
        print(msgpack.unpackb(sample.payload.to_bytes())["position"], flush=True)
