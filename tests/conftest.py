"""Before any test: kernels are pinned in the workers, property tests draw the same examples in every run.

`make soak` draws others each time.
"""

import os
import signal

from hypothesis import HealthCheck, settings

import caneflow  # noqa: F401 - first: processes that are started from here, the workers too, compute as a flow does

# Where a script starts the tests in the background, Ctrl-C is ignored, and every program that they start would inherit
# that.
for number in (signal.SIGINT, signal.SIGHUP):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)

# A run that nobody changed must not turn red: what only another draw finds is found where it is looked for, and a busy
# machine is not a fault of the test.
loaded = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("same", loaded, derandomize=True)
settings.register_profile("others", loaded, derandomize=False)
settings.load_profile(os.environ.get("CANEFLOW_EXAMPLES", "same"))
