"""caneflow's relay: hands each sample on; its host decodes, numbers and encodes."""

from typing import Any

from benchmarks.work import KINDS, Job
from caneflow.messages import Sample
from caneflow.runtime import Context, Emitted, Operator
from caneflow.runtime.node import run


class HopRelay(Operator):
    """The same sample again."""

    inputs = {"in": KINDS[Job.told().kind]}
    outputs = {"out": KINDS[Job.told().kind]}

    def __init__(self, settings: Any, context: Context) -> None: ...

    def handle(self, port: str, message: Sample) -> Emitted:
        """Hand it on."""
        return (("out", message),)


if __name__ == "__main__":
    run(HopRelay)
