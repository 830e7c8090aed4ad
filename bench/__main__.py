"""python -m bench exact|memory|peers|precision|query|sweep|update [--device D] [--json FILE]"""

import argparse
import json
import sys

import warp as wp

from . import exact, memory, peers, precision, query, sweep, update

CASES = {
    "exact": exact.run,
    "memory": memory.run,
    "peers": peers.run,
    "precision": precision.run,
    "query": query.run,
    "sweep": sweep.run,
    "update": update.run,
}


def main(argv=None):
    parser = argparse.ArgumentParser(prog="python -m bench", description=__doc__)
    parser.add_argument("name", choices=sorted(CASES))
    parser.add_argument("--device", default=None)
    parser.add_argument("--json", metavar="FILE", help="write the rows to a file as well")
    parser.add_argument("--count", type=int, help="exact: random pairs; a tenth as many adversarial ones")
    parser.add_argument("--processes", type=int, help="exact: processes that run the oracle")
    options = parser.parse_args(argv)
    sizes = {name: getattr(options, name) for name in ("count", "processes") if getattr(options, name) is not None}
    if sizes and options.name != "exact":
        parser.error("--count and --processes belong to exact")
    wp.config.log_level = wp.LOG_WARNING
    rows = []
    for row in CASES[options.name](options.device, **sizes):
        rows.append(row)
        print("  ".join(f"{key}={value}" for key, value in row.items()), flush=True)
    if options.json:
        with open(options.json, "w") as file:
            json.dump({"warp": wp.config.version, "rows": rows}, file, indent=1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
