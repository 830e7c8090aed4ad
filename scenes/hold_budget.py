"""The same frames with and without a time budget: what is held, and what error it costs.

python scenes/hold_budget.py [--device cuda:0] [--objects 300] [--frames 240] [--part 3]
"""

import argparse
import gc
from pathlib import Path

from warp_abtree.app import load_scene
from warp_abtree.lod.timing import WorkClock
from warp_abtree.simulate.budget_report import budget_report


def main(words=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default=None)
    parser.add_argument("--objects", type=int, default=300)
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--part", type=float, default=3.0, help="the budget is the finest frame's time over this")
    parser.add_argument("--count-work", action="store_true", help="count tests in place of time, which repeats")
    arguments = parser.parse_args(words)
    clock = WorkClock() if arguments.count_work else None
    path = Path(__file__).with_name("focus.toml")
    loaded = load_scene(path, device=arguments.device, objects=arguments.objects)

    def run(**options):
        frame = loaded.frame(clock=clock, **options)
        frame.warm_up()
        gc.collect()
        gc.freeze()  # a full collection in a frame would break any budget
        frame.run(arguments.frames)
        gc.unfreeze()
        return frame

    finest = run(controller="none")
    costs = sorted(row.total_ms for row in finest.history)
    budget = costs[len(costs) // 2] / arguments.part
    print(f"finest LODs: median {costs[len(costs) // 2]:.2f} ms, worst {costs[-1]:.2f} ms, no error")
    print(f"budget: {budget:.2f} ms")
    found = {}
    for controller in ("paper", "predictive"):
        frame = run(controller=controller, budget_ms=budget)
        found[controller] = verdict = budget_report(frame.history)
        if verdict is None:
            raise SystemExit("the first second is not judged: give more frames")
        print(
            f"{controller:>10}: {verdict['within']:.0%} of frames within it, "
            f"{verdict['within_110_percent']:.0%} within 10 % more, worst {verdict['worst']:.2f} times it, "
            f"mean error {verdict['error_mean']:.3g}"
        )
    return found


if __name__ == "__main__":
    main()
