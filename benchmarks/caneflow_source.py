"""caneflow's source: the job's samples, live."""

import time
from typing import Any

from benchmarks.work import KINDS, Job, samples
from caneflow.runtime import Brought, Context, Source
from caneflow.runtime.node import run


class HopSource(Source):
    """Sends the job's samples, then is silent."""

    outputs = {"out": KINDS[Job.told().kind]}

    def __init__(self, settings: Any, context: Context) -> None: ...

    def samples(self) -> Brought:
        """Yield each when it is due."""
        for sample in samples(Job.told()):
            yield "out", sample
        time.sleep(3600)


if __name__ == "__main__":
    run(HopSource)
