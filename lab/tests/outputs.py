"""Reads with other programs' libraries what tandem-lab writes.

`can LOG FILE`: python-can reads the log in candump format and the other file, and all frames are equal.
"""

import sys

import can


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


if __name__ == "__main__":
    {"can": compare_logs}[sys.argv[1]](*sys.argv[2:])
