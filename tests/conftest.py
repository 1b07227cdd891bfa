"""Before any test: kernels are pinned in the workers; property tests draw the same examples in every run.

`make soak` draws others each time.
"""

import os

from hypothesis import settings

import caneflow  # noqa: F401 - first: processes that are started from here, the workers too, compute as a flow does

# A run that nobody changed must not turn red: what only another draw finds is found where it is looked for.
settings.register_profile("same", derandomize=True)
settings.register_profile("others", derandomize=False)
settings.load_profile(os.environ.get("CANEFLOW_EXAMPLES", "same"))
