"""Python imports this at its start: watches a reading process (vehest.sources.limited) that a
watched command starts.
"""

import os

if "FUZZ_CASE" in os.environ:
    from fuzz.watched import watch_reader

    watch_reader()
