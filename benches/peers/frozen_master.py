#!/usr/bin/env python3
"""How long until a frozen master is noticed: keepalived (VRRP), FRR's bfdd (BFD) and Tandem.

Run as root on a Debian with the packages keepalived and frr:

    benches/peers/frozen_master.py [--count 20] [--tandem target/release/tandem]

Each peer runs in two network namespaces joined by a veth pair, with the fastest settings that it
accepts. The master's processes are frozen (SIGSTOP); the time ends when the other side
 - keepalived: has become master, as its notify FIFO says,
 - bfdd: has declared the session down, as its log says (it detects; nothing takes over),
 - Tandem: has sent its first control frame, as the CAN log says.
Then the frozen one continues, or is reset, and the next round begins when both are back.
"""

import argparse
import os
import pathlib
import random
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import time

PATIENCE_S = 30.0


class Namespaces:
    """Two network namespaces, 10.0.0.1 and 10.0.0.2, which are gone at the end."""

    def __init__(self):
        self.names = [f"tandem-peer-{side}-{os.getpid()}" for side in "ab"]

    def __enter__(self):
        for name in self.names:
            run("ip", "netns", "add", name)
        ends = [f"tp{side}{os.getpid()}" for side in "ab"]
        run("ip", "link", "add", ends[0], "type", "veth", "peer", "name", ends[1])
        for number, (name, end) in enumerate(zip(self.names, ends)):
            run("ip", "link", "set", end, "netns", name, "name", "eth0")
            run("ip", "-n", name, "address", "add", f"10.0.0.{number + 1}/24", "dev", "eth0")
            for link in ["lo", "eth0"]:
                run("ip", "-n", name, "link", "set", link, "up")
        return self

    def __exit__(self, *_):
        for name in self.names:
            subprocess.run(["ip", "netns", "del", name], check=False)

    def start(self, number, *command):
        command = ["ip", "netns", "exec", self.names[number], *command]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def run(*command):
    subprocess.run(command, check=True, capture_output=True)


def family(pid):
    """A process and all below it."""
    found, todo = [], [pid]
    while todo:
        pid = todo.pop()
        found.append(pid)
        for tasks in pathlib.Path(f"/proc/{pid}/task").glob("*/children"):
            todo += [int(child) for child in tasks.read_text().split()]
    return found


def send(processes, number):
    for pid in processes:
        try:
            os.kill(pid, number)
        except ProcessLookupError:
            pass


def end(processes):
    for process in processes:
        pids = family(process.pid)
        send(pids, signal.SIGCONT)
        send(pids, signal.SIGKILL)
        process.wait()


class Tail:
    """New lines of a file or a FIFO, each with the time at which it was read."""

    def __init__(self, path):
        self.fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        self.rest = b""

    def lines(self):
        try:
            self.rest += os.read(self.fd, 1 << 16)
        except BlockingIOError:
            return []
        *whole, self.rest = self.rest.split(b"\n")
        return [line.decode(errors="replace") for line in whole]

    def until(self, pattern, patience_s=PATIENCE_S):
        """The time at which a line was seen that matches."""
        begin = time.monotonic()
        while time.monotonic() < begin + patience_s:
            if any(re.search(pattern, line) for line in self.lines()):
                return time.monotonic()
            time.sleep(0.0002)
        raise TimeoutError(f"no line with {pattern}")


def keepalived(count, folder):
    settings = """
global_defs {{
    notify_fifo {fifo}
    vrrp_version 3
    vrrp_rt_priority 50
}}
vrrp_instance V {{
    state {state}
    interface eth0
    virtual_router_id 7
    priority {priority}
    advert_int 0.01
    virtual_ipaddress {{ 10.0.0.100/24 }}
}}
"""
    with Namespaces() as spaces:
        tails, processes = [], []
        for number, (state, priority) in enumerate([("MASTER", 250), ("BACKUP", 240)]):
            fifo, config = folder / f"fifo{number}", folder / f"keepalived{number}.conf"
            os.mkfifo(fifo)
            tails.append(Tail(fifo))
            config.write_text(settings.format(fifo=fifo, state=state, priority=priority))
            process = spaces.start(
                number, "keepalived", "--dont-fork", "--vrrp", "--use-file", str(config),
                "--pid", str(folder / f"pid{number}"),
                "--vrrp_pid", str(folder / f"vrrp-pid{number}"),
            )
            processes.append(process)
        took = []
        try:
            tails[0].until("MASTER")
            for _ in range(count):
                time.sleep(1.0 + random.random() * 0.1)
                tails[1].lines()
                master = family(processes[0].pid)
                begin = time.monotonic()
                send(master, signal.SIGSTOP)
                took.append(tails[1].until("MASTER") - begin)
                send(master, signal.SIGCONT)
                tails[1].until("BACKUP")
        finally:
            end(processes)
        return took


def calm(tail):
    """Waits until the session has been up for a second."""
    up = since = None
    begin = time.monotonic()
    while time.monotonic() < begin + PATIENCE_S:
        for line in tail.lines():
            if "state-change" in line:
                up, since = "-> up" in line, time.monotonic()
        if since is None or (up and time.monotonic() > since + 1.0):
            if time.monotonic() > begin + 1.0:
                return
        time.sleep(0.01)
    raise TimeoutError("the session does not stay up for a second")


def bfdd(count, folder):
    os.chmod(folder, 0o777)
    settings = """
log file {log} debugging
debug bfd peer
bfd
 peer 10.0.0.{other} interface eth0
  detect-multiplier 2
  receive-interval 10
  transmit-interval 10
 exit
exit
"""
    with Namespaces() as spaces:
        tails, processes, daemons = [], [], []
        for number in range(2):
            log, config = folder / f"bfdd{number}.log", folder / f"bfdd{number}.conf"
            log.touch()
            log.chmod(0o666)
            tails.append(Tail(log))
            config.write_text(settings.format(log=log, other=2 - number))
            config.chmod(0o666)
            sockets = folder / f"sockets{number}"
            sockets.mkdir()
            sockets.chmod(0o777)
            places = [f"--vty_socket={sockets}", "-z", str(sockets / "zserv"), "-i"]
            zebra = spaces.start(number, "/usr/lib/frr/zebra", *places, str(folder / f"z{number}"))
            time.sleep(1.0)
            # Real-time priority, like Tandem's: without it, a busy machine causes false alarms.
            daemon = spaces.start(
                number, "chrt", "-f", "50", "/usr/lib/frr/bfdd", *places, str(folder / f"b{number}"),
                "-f", str(config), "--bfdctl", str(folder / f"bfdctl{number}"),
            )
            processes += [zebra, daemon]
            daemons.append(daemon)
        took = []
        try:
            tails[1].until(r"state-change.*-> up")
            for _ in range(count):
                calm(tails[1])
                time.sleep(random.random() * 0.1)
                master = family(daemons[0].pid)
                begin = time.monotonic()
                send(master, signal.SIGSTOP)
                took.append(tails[1].until(r"state-change.*up -> down") - begin)
                send(master, signal.SIGCONT)
                tails[1].until(r"state-change.*-> up")
        finally:
            end(processes)
        return took


FREEZES = 4  # A system that was reset abnormally more than three times in a row suspends itself.


def tandem(count, folder, program):
    took = []
    while len(took) < count:
        out = folder / f"run{len(took)}"
        process = subprocess.Popen(
            [program, "run", "--scenario", "free-lane", "--duration", "55s", "--reintegrate",
             "--quiet", "--out", out],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )
        freezes = []
        for _ in range(FREEZES):
            pid, master = wait_for_pair(program)
            time.sleep(1.0 + random.random() * 0.1)
            freezes.append((time.time(), master))
            os.kill(pid, signal.SIGSTOP)
            time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        process.wait()
        frames = []
        for line in (out / "candump.log").read_text().splitlines():
            found = re.match(r"\((\d+\.\d+)\) \S+ 0A([01])#", line)
            if found:
                frames.append((float(found[1]), "AB"[int(found[2])]))
        for at, master in freezes:
            first = [when for when, who in frames if when > at and who != master]
            took.append(first[0] - at)
    return took


def wait_for_pair(program):
    """Process and system of the master's control core, when the other is its standby."""
    import json

    begin = time.monotonic()
    while time.monotonic() < begin + PATIENCE_S:
        told = subprocess.run([program, "ps", "--json"], capture_output=True, check=True).stdout
        cores = [it for it in json.loads(told) if it["kind"] == "core" and it["core"] == 0]
        roles = {it["role"]: it for it in cores}
        if set(roles) == {"master", "standby"}:
            return roles["master"]["pid"], roles["master"]["system"]
        time.sleep(0.05)
    raise TimeoutError("no master with a standby")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--tandem", default="target/release/tandem")
    parser.add_argument("--only", choices=["keepalived", "bfdd", "tandem"])
    args = parser.parse_args()
    cases = {
        "keepalived": ("VRRP, advertisement each 10 ms, real time", keepalived),
        "bfdd": ("BFD, packet each 10 ms, two missing; detection alone", bfdd),
        "tandem": ("first control frame of the new master",
                   lambda count, folder: tandem(count, folder, os.path.abspath(args.tandem))),
    }
    failed = False
    print(f"{'':12} {'median':>9} {'max':>9} {'count':>6}  from SIGSTOP of the master to")
    for name, (what, measure) in cases.items():
        if args.only not in (None, name):
            continue
        with tempfile.TemporaryDirectory(prefix="tandem-peers-") as folder:
            try:
                took = [1e3 * s for s in measure(args.count, pathlib.Path(folder))]
            except (OSError, TimeoutError, subprocess.CalledProcessError) as error:
                print(f"{name:12} not measured: {error}")
                failed = True
                continue
        print(f"{name:12} {statistics.median(took):6.1f} ms {max(took):6.1f} ms {len(took):6}  {what}",
              flush=True)
    sys.exit(failed)


if __name__ == "__main__":
    main()
