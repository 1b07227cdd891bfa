"""How each contender's three processes are started."""

import sys
from collections.abc import Callable
from pathlib import Path

from benchmarks.work import KINDS, Job, sample
from caneflow.messages import numbered, sample_key
from caneflow.recording import RecordingWriter

HERE = Path(__file__).parent
CANEFLOW = [sys.executable, "-m", "caneflow.command"]
DORA = Path(sys.executable).with_name("dora")
PERIOD_NS = 1_000_000  # of a recording's samples

FLOW = """
flow: hop
nodes:
  source: {{ run: {here}/caneflow_source.py }}
  relay: {{ run: {here}/caneflow_relay.py, inputs: {{ in: source/out }} }}
  sink: {{ run: {here}/caneflow_sink.py, inputs: {{ hop: relay/out }} }}
"""
DORA_FLOW = """
nodes:
  - id: source
    path: {python}
    args: {here}/dora_node.py source
    outputs: [out]
  - id: relay
    path: {python}
    args: {here}/dora_node.py relay
    inputs: {{ in: {{ source: source/out, queue_size: 1000 }} }}
    outputs: [out]
  - id: sink
    path: {python}
    args: {here}/dora_node.py sink
    inputs: {{ in: {{ source: relay/out, queue_size: 1000 }} }}
"""


def caneflow(job: Job) -> list[list[str]]:
    """`caneflow run`; as fast as it goes means a recording's replay, which loses nothing."""
    file = Path(job.folder) / "hop.yaml"
    file.write_text(FLOW.format(here=HERE))
    command = [*CANEFLOW, "run", str(file)]
    if not job.rate:
        command += ["--replay", str(recorded(job)), "--speed", "max"]
    return [command]


def recorded(job: Job) -> Path:
    """The job's samples, 1 kHz, as a recording."""
    path = Path(job.folder) / "samples.mcap"
    key = sample_key("hop", "source", "out")
    with RecordingWriter(path, flow="hop", source="simulated", rig={}) as writer:
        for seq in range(job.count):
            message = sample(job, (seq + 1) * PERIOD_NS)
            payload = numbered(message, seq)
            writer.write(key, KINDS[job.kind], payload, stamp=message.stamp, seq=seq, log_time=message.stamp)
    return path


def raw_zenoh(job: Job) -> list[list[str]]:
    """Three peers."""
    return [[sys.executable, "-m", "benchmarks.raw_zenoh", role] for role in ("source", "relay", "sink")]


def dora(job: Job) -> list[list[str]]:
    """`dora run` starts its daemon and the nodes."""
    file = Path(job.folder) / "dora.yml"
    file.write_text(DORA_FLOW.format(python=sys.executable, here=HERE))
    return [[str(DORA), "run", str(file)]]


def seqpacket(job: Job) -> list[list[str]]:
    """The floor."""
    return [[sys.executable, "-m", "benchmarks.seqpacket", role] for role in ("sink", "relay", "source")]


CONTENDERS: dict[str, Callable[[Job], list[list[str]]]] = {
    "caneflow": caneflow,
    "raw Zenoh": raw_zenoh,
    "dora": dora,
    "Unix socket": seqpacket,
}
