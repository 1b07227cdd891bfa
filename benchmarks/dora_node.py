"""dora's Python API: three nodes of a dora dataflow. `python benchmarks/dora_node.py source|relay|sink`."""

import sys

import numpy as np
import pyarrow as pa
from dora import Node

from benchmarks.work import KINDS, Job, Notes, relayed, samples
from caneflow.messages import decode, numbered


def arrow(payload: bytes) -> pa.Array:
    """Bytes as dora sends them."""
    return pa.array(np.frombuffer(payload, np.uint8))


def main(role: str, job: Job) -> None:
    """Play one role to the end."""
    node = Node()
    if role == "source":
        for seq, message in enumerate(samples(job)):
            node.send_output("out", arrow(numbered(message, seq)))
        for _ in node:  # until it is told to stop
            pass
        return
    work, notes, kind = relayed(job), Notes(job), KINDS[job.kind]
    for event in node:
        if event["type"] != "INPUT":
            continue
        payload = event["value"].to_numpy().tobytes()
        if role == "relay":
            node.send_output("out", arrow(work(payload)))
        else:
            notes.take(decode(payload, kind))


if __name__ == "__main__":
    main(sys.argv[1], Job.told())
