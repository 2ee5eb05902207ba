#!/usr/bin/env python3
"""What a drive costs that nothing disturbs: wake-ups and CPU of each thread, beside cyclictest.

Run as root on a Debian with the package rt-tests, on a machine with nothing else to do:

    benches/peers/drive_at_rest.py target/release/tandem [OTHER] [--turns 3] [--seconds 10]

In each turn, cyclictest first runs two bare loops of 1 kHz (`clock_nanosleep`, SCHED_FIFO, each pinned
to a CPU), as the cores 0 of a drive have; then each program drives once. Counted are voluntary
switches and run time of all threads in the middle of the drive, from /proc. A share is of one CPU.
"""

import argparse
import collections
import pathlib
import statistics
import subprocess
import tempfile
import time

from frozen_master import family

# Until both systems drive, and their first frames have made their memory resident.
WARM_UP_S = 4.0


def threads(root):
    """(name, wake-ups, run time in ns) of each thread of a process and of all below it."""
    found = {}
    for pid in family(root):
        for task in pathlib.Path(f"/proc/{pid}/task").glob("*"):
            try:
                command = (task / "cmdline").read_text().split("\0")
                comm = (task / "comm").read_text().strip()
                status = (task / "status").read_text()
                ran_ns = int((task / "schedstat").read_text().split()[0])
            except OSError:
                continue
            found[pid, task.name] = (name(command, comm), int(field(status)), ran_ns)
    return found


def field(status):
    return status.split("\nvoluntary_ctxt_switches:")[1].split()[0]


def name(command, comm):
    """What a thread is: the part of the run by its arguments, and the thread's name if it has one."""
    part = next((word.strip("_") for word in command if word.startswith("__") and word != "__application"), None)
    part = part or next((word for word in command if word in ("run", "publish")), command[0])
    return f"{part}: {comm}" if comm in ("kernel", "doorbell", "recorder") else part


def measure(root, seconds):
    """Wake-ups a second and per cent of a CPU, for each name."""
    begin, before = time.monotonic(), threads(root)
    time.sleep(seconds)
    after, span = threads(root), time.monotonic() - begin
    rows = collections.defaultdict(lambda: [0.0, 0.0])
    for thread, (what, woken, ran_ns) in after.items():
        if thread in before:
            rows[what][0] += (woken - before[thread][1]) / span
            rows[what][1] += (ran_ns - before[thread][2]) / span / 1e7
    return dict(rows)


def beside(command, warm_up_s, seconds):
    running = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        time.sleep(warm_up_s)
        rows = measure(running.pid, seconds)
        if running.poll() is not None:
            raise SystemExit(f"{command} ended before it was measured")
        return rows
    finally:
        running.wait()


def floor(seconds):
    span = str(int(seconds) + 2)
    # Without --latency it keeps the CPUs from going idle, and its loops cost half as much.
    loops = ["cyclictest", "--latency=1000000", "-q", "-t2", "-a", "-p70", "-i1000", "-d0", "-D", span]
    return beside(loops, 1, seconds)


def drive(program, seconds):
    with tempfile.TemporaryDirectory() as out:
        span = f"{WARM_UP_S + seconds + 2}s"
        return beside([program, "run", "--duration", span, "--out", out], WARM_UP_S, seconds)


def total(rows):
    return [sum(row[column] for row in rows.values()) for column in (0, 1)]


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("programs", nargs="+")
    arguments.add_argument("--turns", type=int, default=3)
    arguments.add_argument("--seconds", type=float, default=10.0)
    given = arguments.parse_args()
    runs = {program: [] for program in given.programs}
    for turn in range(given.turns):
        bare = total(floor(given.seconds))[1]
        print(f"turn {turn}: two bare loops {bare:.2f} %")
        # The other way round in every second turn.
        for program in given.programs[:: 1 if turn % 2 == 0 else -1]:
            rows = drive(program, given.seconds)
            runs[program].append(rows)
            woken, cpu = total(rows)
            print(f"turn {turn}: {program} {woken:.0f} /s, {cpu:.2f} %, {cpu / bare:.2f} times the loops", flush=True)
    for program, turns in runs.items():
        print(f"\n{program}, medians of {len(turns)} turns:")
        names = {what for rows in turns for what in rows}
        medians = {
            what: [statistics.median(rows.get(what, (0.0, 0.0))[column] for rows in turns) for column in (0, 1)]
            for what in names
        }
        cpu = statistics.median(total(rows)[1] for rows in turns)
        print(f"{sum(row[0] for row in medians.values()):8.1f} /s {cpu:6.2f} %  in all")
        for what, (woken, cpu) in sorted(medians.items(), key=lambda row: -row[1][1]):
            each = f"{cpu * 1e4 / woken:8.1f} us each" if woken >= 1 else ""
            print(f"{woken:8.1f} /s {cpu:6.2f} % {each}  {what}")


if __name__ == "__main__":
    main()
