"""What pip would install, from its report on standard input, as lines of constraints.txt."""

import json
import platform
import sys

found = [each["metadata"] for each in json.load(sys.stdin)["install"] if "dir_info" not in each["download_info"]]
print(f"# Made by `make lock` with Python {platform.python_version()}; `make test LOCKED=1` installs these versions.")
print(*sorted(f"{each['name'].lower()}=={each['version']}" for each in found), sep="\n")
