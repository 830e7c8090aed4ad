"""A planner of OMPL over a robot: a state is valid where nothing intersects, a motion where that is proved all the way.

python scenes/interop/ompl_planner.py ROBOT.urdf AROUND.glb --mounted base plans between two random configurations that
are free (docs/howto_robot.md); extra `robot`, and ompl, whose planners ask one by one, at some milliseconds a call.
"""

import argparse

import numpy as np

import warp_abtree as ab


def plan(robot, scene, start, goal, seconds=20.0):
    """Return the configurations of a way from start to goal, (k, n), or None if none was found in time."""
    from ompl import base, geometric

    space = base.RealVectorStateSpace(len(start))
    bounds = base.RealVectorBounds(len(start))
    for k, (low, high) in enumerate(robot.limits.tolist()):
        bounds.setLow(k, low)
        bounds.setHigh(k, high)
    space.setBounds(bounds)

    def read(state):
        return np.array([state[k] for k in range(len(start))])

    class ProvedMotions(base.MotionValidator):
        def checkMotion(self, first, second, *_):
            return bool(robot.check_edges(read(first), read(second), scene)["clear"])

    setup = geometric.SimpleSetup(space)
    information = setup.getSpaceInformation()
    motions = ProvedMotions(information)  # OMPL does not hold on to it
    information.setMotionValidator(motions)
    setup.setStateValidityChecker(lambda state: not robot.check(read(state), scene))
    ends = space.allocState(), space.allocState()
    for k in range(len(start)):
        ends[0][k], ends[1][k] = float(start[k]), float(goal[k])
    setup.setStartAndGoalStates(*ends)
    setup.setPlanner(geometric.RRTConnect(information))
    return np.array([read(state) for state in setup.getSolutionPath().getStates()]) if setup.solve(seconds) else None


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("robot", help="URDF or MJCF file")
    parser.add_argument("around", help="mesh file of what surrounds it")
    parser.add_argument("--mounted", nargs="*", default=(), help="links that are not tested against it")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(argv)
    robot = ab.Robot.load(options.robot, device="cpu", mounted=options.mounted)
    scene = ab.scene_from_file(options.around, device="cpu")
    rng = np.random.default_rng(options.seed)
    configurations = rng.uniform(*robot.limits.T, (1000, len(robot.joint_names)))
    free = configurations[~robot.check(configurations, scene)]
    way = plan(robot, scene, *free[:2])
    print("no way was found" if way is None else f"{len(way)} configurations, a way from each to the next proved free")
    return way


if __name__ == "__main__":
    main()
