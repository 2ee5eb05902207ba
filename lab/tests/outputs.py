"""Reads with other programs' libraries what tandem-lab writes.

`can LOG FILE`: python-can reads the log in candump format and the other file, and all frames are equal.
`solution SCENARIO FILE`: commonroad-io reads the solution. Prints its benchmark id, the number of its states and what the
drivability checker says of it.
"""

import sys


def frame(message, start):
    # The formats have different places for the time of the start, so times count from the first frame, µs.
    return (
        round((message.timestamp - start) * 1e6),
        message.arbitration_id,
        message.is_extended_id,
        message.is_fd,
        message.bitrate_switch,
        message.error_state_indicator,
        message.is_remote_frame or message.is_error_frame,
        message.dlc,
        bytes(message.data),
    )


def frames(path):
    import can

    with can.LogReader(path) as reader:
        messages = list(reader)
    # By the name of the bus in one format, by its number in the other.
    names = {}
    for message in messages:
        names.setdefault(message.channel, len(names))
    start = messages[0].timestamp
    return [(names[message.channel], *frame(message, start)) for message in messages]


def compare_logs(log, file):
    expected, found = frames(log), frames(file)
    for index, (one, other) in enumerate(zip(expected, found)):
        assert one == other, f"frame {index}: {one} in {log}, {other} in {file}"
    assert len(expected) == len(found), f"{len(expected)} and {len(found)} frames"
    print(len(found))


def check_solution(scenario_file, file):
    from commonroad.common.file_reader import CommonRoadFileReader
    from commonroad.common.solution import CommonRoadSolutionReader

    scenario, problems = CommonRoadFileReader(scenario_file).open()
    solution = CommonRoadSolutionReader.open(file)
    (own,) = solution.planning_problem_solutions
    states = own.trajectory.state_list
    steps = [state.time_step for state in states]
    start = problems.planning_problem_dict[own.planning_problem_id].initial_state
    assert str(solution.scenario_id) == str(scenario.scenario_id), solution.benchmark_id
    assert steps == list(range(start.time_step, start.time_step + len(steps))), steps
    print(solution.benchmark_id)
    print(len(states))
    try:
        from commonroad_dc.feasibility import solution_checker as checker
    except ImportError as error:
        print(f"checker: {error}")
        return
    # All of valid_solution() except the road's boundary, for which the checker needs a package that is not free.
    for name, check in [
        ("all solved", lambda: checker.solved_all_problems(problems, solution)),
        ("start", lambda: checker.starts_at_correct_state(solution, problems)),
        ("goal", lambda: checker.goal_reached(scenario, problems, solution)),
        ("no collision", lambda: not checker.obstacle_collision(scenario, problems, solution)),
        ("feasible", lambda: all(it[0] for it in checker.solution_feasible(solution, scenario.dt, problems).values())),
    ]:
        try:
            print(f"{name}: {'yes' if check() else 'no'}")
        except checker.SolutionCheckerException as error:
            print(f"{name}: no, {str(error).splitlines()[0]}")


if __name__ == "__main__":
    {"can": compare_logs, "solution": check_solution}[sys.argv[1]](*sys.argv[2:])
