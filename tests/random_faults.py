#!/usr/bin/env python3
"""Random faults on the real processes of one run: kill, stop, stop and continue, power on again.

    tests/random_faults.py [--count 200] [--seed 1] [--tandem target/release/tandem] [--keep FOLDER]

Before each fault both systems must be in a role: the claim of the product is one fault at a time. A
supply that was killed, or a system that suspended itself, is switched on again by `tandem power on`.
Fails if the run does not end with exit status 0, if there were two masters, if anything is left
behind, or if a gap beyond its bound has no stall of the machine that explains it.
"""

import argparse
import collections
import json
import os
import pathlib
import random
import signal
import subprocess
import sys
import tempfile
import time

DUAL_WITHIN_S = 60
# From one fault to the next: a system that comes back is standby after about 2 s.
FAULT_S = 4.0
ROLES_THAT_DRIVE = ("master", "degraded")


class Run:
    def __init__(self, args, folder):
        self.tandem = args.tandem
        duration = args.count * FAULT_S + 30
        self.stdout = folder / "metrics.json"
        self.stderr = folder / "stderr.txt"
        command = [
            args.tandem, "run", "--json", "--reintegrate", "--scenario", "free-lane",
            "--duration", str(duration), "--out", str(folder / "report"),
        ]
        with open(self.stdout, "w") as out, open(self.stderr, "w") as err:
            self.process = subprocess.Popen(command, stdout=out, stderr=err, stdin=subprocess.DEVNULL)
        self.name = f"tandem-{self.process.pid}-"
        self.began = False

    def processes(self):
        """Its processes, as `tandem ps` lists them."""
        listed = subprocess.run([self.tandem, "ps", "--json"], capture_output=True, text=True)
        found = json.loads(listed.stdout or "[]")
        return [process for process in found if self.is_mine(process["pid"])]

    def is_mine(self, pid):
        try:
            return self.name in pathlib.Path(f"/proc/{pid}/cmdline").read_text(errors="replace")
        except OSError:
            return False

    def full_name(self):
        """The run's name, which each of its processes has among its arguments."""
        for process in self.processes():
            words = pathlib.Path(f"/proc/{process['pid']}/cmdline").read_text(errors="replace").split("\0")
            for word in words:
                if word.startswith(self.name):
                    return word
        sys.exit("the run has no process")

    def power_on(self, system):
        command = [self.tandem, "power", "on", system, "--run", self.full_name()]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode != 0:
            sys.exit(f"tandem power on {system}: {done.stderr}")

    def until_dual(self):
        """Waits until one system drives and the other stands by; its processes then."""
        off, suspended = collections.Counter(), collections.Counter()
        until = time.monotonic() + DUAL_WITHIN_S
        while time.monotonic() < until:
            if self.process.poll() is not None:
                sys.exit(f"the run ended too early: {self.stderr.read_text()}")
            processes = self.processes()
            supplies = {p["system"]: p for p in processes if p["kind"] == "supply"}
            roles = {system: p["role"] for system, p in supplies.items()}
            drives = [s for s, role in roles.items() if role in ROLES_THAT_DRIVE]
            if len(processes) == 9 and len(drives) == 1 and "standby" in roles.values():
                self.began = True
                return processes
            for system in "AB":
                if not self.began:
                    continue
                if system not in supplies:
                    off[system] += 1
                    if off[system] == 10:
                        self.power_on(system)
                elif roles[system] in ("suspended", None):
                    # Too many resets in a row: held until the next power cycle.
                    suspended[system] += 1
                    if suspended[system] == 30:
                        off[system], suspended[system] = 0, 0
                        send(supplies[system]["pid"], signal.SIGKILL)
                else:
                    suspended[system] = 0
            time.sleep(0.1)
        sys.exit(f"no dual operation within {DUAL_WITHIN_S} s: {processes}")


def send(pid, number):
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        pass


def inject(run, processes, dice):
    """One fault at a random process; its name."""
    victims = processes + [{"pid": run.process.pid, "kind": "run", "system": None, "core": None, "role": None}]
    victim = dice.choice(victims)
    of = {"supply": "supply", "core": f"core {victim['core']}", "vehicle": "vehicle", "run": "tandem run"}
    what = of[victim["kind"]]
    # The run ends with its vehicle and with its command, and a supply that stands still for good
    # has nobody who would notice.
    actions = {"core": ["kill", "stop", "pause"], "supply": ["kill", "pause"]}.get(victim["kind"], ["pause"])
    action = dice.choice(actions)
    if action == "kill":
        send(victim["pid"], signal.SIGKILL)
    else:
        send(victim["pid"], signal.SIGSTOP)
    if action == "pause":
        time.sleep(dice.uniform(0.005, 0.2))
        send(victim["pid"], signal.SIGCONT)
    drove = [p["role"] in ROLES_THAT_DRIVE for p in processes
             if p["kind"] == "supply" and p["system"] == victim["system"]]
    role = "" if victim["system"] is None else " of the master" if drove[0] else " of the standby"
    return f"{action} {what}{role}"


def judge(run, counts):
    """What was wrong, in words."""
    status = run.process.wait()
    text = run.stdout.read_text()
    wrong = [] if status == 0 else [f"exit status {status}: {run.stderr.read_text().strip()}"]
    if not text:
        return wrong + ["no metrics"]
    metrics = json.loads(text)
    for name in ["two_masters_ms", "collisions", "false_takeovers", "stale_frames"]:
        if metrics[name] != 0:
            wrong.append(f"{name}: {metrics[name]}")
    if metrics["leftovers"] or run.processes():
        wrong.append(f"left behind: {metrics['leftovers']} {run.processes()}")
    wrong += [f"{path} is left" for folder in ("/dev/shm", "/tmp")
              for path in pathlib.Path(folder).glob(f"*{run.name}*")]
    print(f"{sum(counts.values())} faults, {len(metrics['takeovers'])} takeovers, largest gap "
          f"{metrics['control_gap_max_ms']:.1f} ms, both transmitted {metrics['both_transmitted_ms']:.1f} ms, "
          f"stalls {metrics['stalls']}")
    for what, times in sorted(counts.items()):
        print(f"  {times:4}  {what}")
    for gap in metrics["gaps"]:
        told = f"{gap['gap_ms']:.1f} ms at {gap['at_s']:.2f} s (bound {gap['bound_ms']:.0f} ms, {gap['ended_by']})"
        print(f"gap of {told}: {gap['evidence'] or 'no stall explains it'}")
        if not gap["explained"]:
            wrong.append(f"unexplained gap of {told}")
    return wrong


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--tandem", default="target/release/tandem")
    parser.add_argument("--keep", type=pathlib.Path, help="folder for the run's report")
    args = parser.parse_args()
    dice = random.Random(args.seed)
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.keep or pathlib.Path(temporary)
        folder.mkdir(exist_ok=True)
        run, counts = Run(args, folder), collections.Counter()
        try:
            for number in range(args.count):
                processes = run.until_dual()
                # At any moment of the control period, and of everything else.
                time.sleep(dice.uniform(0.3, 0.6))
                what = inject(run, processes, dice)
                counts[what] += 1
                print(f"{number + 1:4} {what}", file=sys.stderr, flush=True)
            wrong = judge(run, counts)
        finally:
            for process in run.processes():
                send(process["pid"], signal.SIGKILL)
            run.process.kill()
    for what in wrong:
        print(f"WRONG: {what}")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
