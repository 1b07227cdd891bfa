"""The documentation as a site: `make docs` builds it into build/site; a warning is an error."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import reference_pages

import caneflow

project = "caneflow"
author = "the caneflow authors"
version = release = caneflow.__version__
extensions = ["myst_parser", "sphinx_copybutton", "equations", "sphinx_gallery.gen_gallery"]
sphinx_gallery_conf = {
    "examples_dirs": "../examples/notebooks",
    "gallery_dirs": "notebooks",
    "filename_pattern": r"\.py",  # each is run
    "abort_on_example_error": True,
    "within_subsection_order": "FileNameSortKey",
    "copyfile_regex": r".*\.md",
    "nested_sections": False,
    "remove_config_comments": True,
    "capture_repr": (),  # only what is printed
    "show_memory": False,
    "write_computation_times": False,  # its page asks other servers for a table
    "min_reported_time": 3600,
}
html_math_renderer = "mathml"
myst_enable_extensions = ["dollarmath", "amsmath", "deflist"]
myst_heading_anchors = 3
html_theme = "furo"
html_title = "caneflow"
exclude_patterns = ["performance_peers.md", "performance_scaling.md"]  # parts of performance.md
suppress_warnings = ["myst.xref_missing"]  # links to files of the repository that are not pages of the site

reference_pages.write(Path(__file__).parent / "reference")
