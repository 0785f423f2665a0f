"""Write versions into the published keys in results/ that an earlier commit's check finds unchanged.

    git worktree add ../before 7652af5
    python docs/rewrite_keys.py ../before

An entry whose code is that of the earlier commit gets today's version text; an entry that differs keeps its hash, so that
`vehest report --check` names the same studies as stale, for the same causes, as it did there.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

RESULTS = Path("results")
LIST_KEYS = """
import importlib.util
import json

if importlib.util.find_spec("vehest.stages"):
    from vehest.stages import published_check
else:
    from vehest.run import published_check

keys_of_study, listed = published_check.keys_of_study, {}

def keys_listed(pipeline, *arguments):
    listed[pipeline.study] = keys_of_study(pipeline, *arguments)
    return listed[pipeline.study]

published_check.keys_of_study = keys_listed
published_check.check_published([])
print(json.dumps(listed))
"""


def keys_of(checkout: Path) -> dict[str, dict[str, dict[str, str]]]:
    """Study -> what is made -> cause -> value, as a checkout computes them for the studies published here."""
    environment = os.environ | {"PYTHONPATH": str(checkout.resolve() / "src")}
    done = subprocess.run([sys.executable, "-c", LIST_KEYS], env=environment, stdout=subprocess.PIPE, text=True, check=True)
    keys: dict[str, dict[str, dict[str, str]]] = json.loads(done.stdout)
    return keys


def main() -> None:
    """Rewrite every published provenance; say how many entries of each study were rewritten."""
    before, today = keys_of(Path(sys.argv[1])), keys_of(Path(__file__).parents[1])
    for study in before:
        file = RESULTS / study / "provenance.json"
        about = json.loads(file.read_text(encoding="utf-8"))
        coded = {name: entry for name, entry in about["keys"].items() if "code" in entry}
        same = [name for name, entry in coded.items() if entry["code"] == before[study].get(name, {}).get("code")]
        for name in same:
            coded[name]["code"] = today[study][name]["code"]
        file.write_text(json.dumps(about, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        print(f"{study}: {len(same)} of {len(coded)} entries rewritten")


if __name__ == "__main__":
    main()
