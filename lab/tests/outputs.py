"""Reads with other programs' libraries what tandem-lab writes.

`can LOG FILE`: python-can reads the log in candump format and the other file, and all frames are equal.
`decode LOG DBC`: python-can reads the log, cantools decodes each frame, autosar-e2e checks its protection. Prints for each
frame `id data protected name=value …`, id and data in hex, the values as numbers; 1 means protected, 0 not. A frame that is
not in the DBC has no value.
`solutions SCENARIOS SOLUTIONS`: commonroad-io reads each `solution_NAME` of the folder. Prints in a line NAME, the
benchmark id, the number of states and, after a tab each, what the drivability checker says.
"""

import sys
from pathlib import Path


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


def decode(log, dbc):
    import can
    import cantools
    import e2e

    messages = {it.frame_id: it for it in cantools.database.load_file(dbc).messages}
    with can.LogReader(log) as reader:
        for it in reader:
            data = bytes(it.data)
            message = None if it.is_extended_id else messages.get(it.arbitration_id)
            values = message.decode(data, decode_choices=False) if message else {}
            protected = int("Crc" in values and e2e.p05.e2e_p05_check(data, it.arbitration_id))
            print(f"{it.arbitration_id:x}", data.hex(), protected, *(f"{k}={v!r}" for k, v in values.items()))


def check_solutions(scenarios, solutions):
    for file in sorted(Path(solutions).iterdir()):
        name = file.name.removeprefix("solution_")
        print(name, *check_solution(Path(scenarios) / name, file), sep="\t")


def check_solution(scenario_file, file):
    from commonroad.common.file_reader import CommonRoadFileReader
    from commonroad.common.solution import CommonRoadSolutionReader

    scenario, problems = CommonRoadFileReader(str(scenario_file)).open()
    solution = CommonRoadSolutionReader.open(str(file))
    (own,) = solution.planning_problem_solutions
    states = own.trajectory.state_list
    steps = [state.time_step for state in states]
    start = problems.planning_problem_dict[own.planning_problem_id].initial_state
    assert str(solution.scenario_id) == str(scenario.scenario_id), solution.benchmark_id
    assert steps == list(range(start.time_step, start.time_step + len(steps))), steps
    yield solution.benchmark_id
    yield len(states)
    try:
        from commonroad_dc.feasibility import solution_checker as checker
    except ImportError as error:
        yield f"checker: {error}"
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
            yield f"{name}: {'yes' if check() else 'no'}"
        except checker.SolutionCheckerException as error:
            yield f"{name}: no, {str(error).splitlines()[0]}"


if __name__ == "__main__":
    {"can": compare_logs, "decode": decode, "solutions": check_solutions}[sys.argv[1]](*sys.argv[2:])
