"""The other side of commonroad_oracle.rs: commonroad-io and the drivability checker.

    commonroad_oracle.py read FILE...   what the files hold, a line of JSON each
    commonroad_oracle.py goal FILE      states `step x y yaw speed` from stdin: is the goal reached?
    commonroad_oracle.py overlap        pairs of rectangles `x y yaw length width` from stdin

Answers to stdin are 0 or 1, one for each line.
"""

import json
import sys
import warnings

warnings.filterwarnings("ignore")

import commonroad_dc.pycrcc as checker
import numpy
from commonroad.common.file_reader import CommonRoadFileReader
from commonroad.scenario.state import CustomState


def problem_of(file):
    scenario, problems = CommonRoadFileReader(file).open()
    return scenario, next(iter(problems.planning_problem_dict.values()))


def state(it):
    return [it.time_step, *map(float, it.position), float(it.orientation), float(it.velocity)]


def read(file):
    scenario, problem = problem_of(file)
    obstacles = {}
    for it in scenario.dynamic_obstacles:
        trajectory = it.prediction.trajectory.state_list if it.prediction else []
        obstacles[it.obstacle_id] = [state(s) for s in [it.initial_state, *trajectory]]
    lanelets = {
        it.lanelet_id: [it.left_vertices.tolist(), it.right_vertices.tolist(), sorted(it.successor)]
        for it in scenario.lanelet_network.lanelets
    }
    return {
        "step_s": scenario.dt,
        "ego": state(problem.initial_state),
        "obstacles": obstacles,
        "lanelets": lanelets,
    }


def goal(file):
    region = problem_of(file)[1].goal
    for line in sys.stdin:
        step, x, y, yaw, speed = map(float, line.split())
        it = CustomState(
            time_step=int(step), position=numpy.array([x, y]), orientation=yaw, velocity=speed
        )
        print(int(region.is_reached(it)))


def overlap():
    for line in sys.stdin:
        v = list(map(float, line.split()))
        # The checker takes half lengths, heading, centre.
        a, b = (checker.RectOBB(r[3] / 2, r[4] / 2, r[2], r[0], r[1]) for r in (v[:5], v[5:]))
        print(int(a.collide(b)))


if __name__ == "__main__":
    mode, *files = sys.argv[1:]
    if mode == "read":
        for name in files:
            print(json.dumps(read(name)))
    elif mode == "goal":
        goal(files[0])
    else:
        overlap()
