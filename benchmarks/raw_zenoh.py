"""Raw Zenoh: three peers, explicit links, the work in the callbacks. `python -m benchmarks.raw_zenoh ROLE`."""

import json
import sys
import threading
import time

import zenoh

from benchmarks.work import KINDS, Job, Notes, relayed, samples
from caneflow.messages import decode, numbered

PORTS = {"source": 17461, "relay": 17462}  # who dials whom: relay -> source, sink -> relay
FOREVER = 3600.0


def session(role: str) -> zenoh.Session:
    """A peer with one link to its neighbour and no discovery."""
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    listen = [f"tcp/127.0.0.1:{PORTS[role]}"] if role in PORTS else []
    dial = {"relay": "source", "sink": "relay"}.get(role)
    config.insert_json5("listen/endpoints", json.dumps(listen))
    config.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{PORTS[dial]}"] if dial else []))
    config.insert_json5("connect/retry", '{"period_init_ms": 20, "period_max_ms": 200, "period_increase_factor": 2}')
    config.insert_json5("connect/timeout_ms", "10000")
    return zenoh.open(config)


def publisher(opened: zenoh.Session, key: str, job: Job) -> zenoh.Publisher:
    """At a rate: each sample at once; as fast as it goes: in batches, blocking rather than losing."""
    control = zenoh.CongestionControl.DROP if job.rate else zenoh.CongestionControl.BLOCK
    return opened.declare_publisher(key, congestion_control=control, express=bool(job.rate))


def main(role: str, job: Job) -> None:
    """Play one role to the end."""
    with session(role) as opened:
        if role == "source":
            out = publisher(opened, "hop/first", job)
            while job.wait and not out.matching_status.matching:  # type: ignore[attr-defined]  # the stub says bool
                time.sleep(0.005)
            if job.wait:
                time.sleep(1.0)  # the relay's own link to the sink
            for seq, message in enumerate(samples(job)):
                out.put(numbered(message, seq))
        elif role == "relay":
            out, work = publisher(opened, "hop/second", job), relayed(job)
            held = opened.declare_subscriber("hop/first", lambda sample: out.put(work(sample.payload.to_bytes())))
        else:
            notes, kind = Notes(job), KINDS[job.kind]
            held = opened.declare_subscriber(
                "hop/second", lambda sample: notes.take(decode(sample.payload.to_bytes(), kind))
            )
        threading.Event().wait(FOREVER)
        del held


if __name__ == "__main__":
    main(sys.argv[1], Job.told())
