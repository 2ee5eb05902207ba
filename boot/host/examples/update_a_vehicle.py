#!/usr/bin/env python3
"""Update both systems of a driving vehicle to a release, over CAN.

Needs python-can, and the commands openssl and objcopy. The vehicle keeps driving: one system leaves
for the download while the other one drives. If a system refuses the release, the other one gets its
old release back.

Exit status: 0 both systems have approved the release, 1 refused or failed, 2 wrong usage.
"""

import argparse
import hashlib
import queue
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from pathlib import Path

import can

HOST, ANSWER, RELEASE = 0x0CFF0126, 0x0CFF0127, 0x0CFF0128  # CAN ids

CONNECT, CONNECTED = bytes.fromhex("2d573e08"), bytes(range(8))
ACCEPTED, AGAIN, REFUSED = (bytes.fromhex(x) for x in ("1d4b2100", "534f5300", "4e454400"))
NO_PROOF = 19
REASONS = {
    1: "address outside the flash", 2: "protected address", 3: "this slot boots",
    4: "the file is not signed", 5: "bad manifest", 6: "signature not of an accepted key",
    7: "older than a release that has been approved (downgrade)", 8: "data are missing",
    9: "records overlap", 10: "records do not ascend", 11: "data that the manifest does not name",
    12: "wrong count record", 13: "the file ends too early", 14: "wrong digest", 15: "wrong entry",
    16: "no S-records", 17: "the flash fails", 18: "a record follows the end of the file",
    NO_PROOF: "no proof of a tester's key", 20: "needs a newer bootloader or configuration",
}
STAGES = ("on trial", "works", "ready", "approved")
WORKS, APPROVED = 1, 3

SLOTS = (0x04_0000, 0x10_0000)  # application slots A and B
MANIFEST = 256  # bytes; the body follows
HARDWARE = 0x0297_0001
BODY = b"#!/proc/self/exe __application controller\n"
KEY = 0  # number of the signing key, and of the tester's

WINDOW = 8  # records under way
FRAME_GAP = 0.0005  # s between frames: a bus of 500 kbit/s is not faster
SILENCE = 3.5  # s; the loader may need 3 s to erase a sector
PROOF_HOLDS = 8.0  # s; the desk keeps a proof for 10 s
PATIENCE = 20  # s; how long to wait while no proof is taken


class Failed(Exception):
    """The update has failed; the text says why."""


def name(system):
    """System 1 is A, 2 is B."""
    return f"system {'?AB'[system]}"


def run(*command):
    """Run a command and return its output."""
    try:
        done = subprocess.run(command, capture_output=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise Failed(f"{command[0]}: {error}") from error
    if done.returncode:
        raise Failed(f"{command[0]}: {(done.stderr.decode() or 'failed').splitlines()[0]}")
    return done.stdout


def sign(key, data):
    """The Ed25519 signature of the data with the private key in a DER file."""
    with tempfile.NamedTemporaryFile() as file:
        file.write(data)
        file.flush()
        signature = run("openssl", "pkeyutl", "-sign", "-rawin", "-keyform", "DER",
                        "-inkey", key, "-in", file.name)
    if len(signature) != 64:
        raise Failed(f"{key}: not an Ed25519 key")
    return signature


def build_image(release, key):
    """The manifest, signed, and the body. It is the same for both slots."""
    head = struct.pack("<4sBBBBIIIIBBBB", b"TNDM", 1, 0, 1, KEY, HARDWARE, release,
                       len(BODY), zlib.crc32(BODY), 0, 1, 0, 0)  # the 1 after the CRC: paired
    head += struct.pack("<I", zlib.crc32(head))
    head += struct.pack("<3I", MANIFEST, MANIFEST, MANIFEST)  # entries of cores 0 to 2
    head += struct.pack("<II", MANIFEST, len(BODY)) + hashlib.sha256(BODY).digest()
    head = head.ljust(192, b"\0")
    return head + sign(key, head) + BODY


def s_records(image, slot):
    """The image as S-records for a slot."""
    with tempfile.TemporaryDirectory() as folder:
        binary, text = Path(folder, "app.bin"), Path(folder, "app.srec")
        binary.write_bytes(image)
        run("objcopy", "-I", "binary", "-O", "srec",
            "--change-section-address", f".data={SLOTS[slot]:#x}",
            "--set-start", f"{SLOTS[slot] + MANIFEST:#x}", str(binary), str(text))
        return [line.encode() + b"\n" for line in text.read_text().split()]


class Vehicle(can.Listener):
    """Both systems of a vehicle, on one CAN bus. The bus's thread hands over what it receives."""

    def __init__(self, bus, tester_key):
        super().__init__()
        self.bus = bus
        self.tester_key = tester_key
        self.answers = queue.Queue()
        self.releases = {}  # system: (version, stage, time of the frame)

    def on_message_received(self, msg):
        """Note a release frame, or queue an answer."""
        data = bytes(msg.data)
        if msg.arbitration_id == ANSWER and len(data) == 8:
            self.answers.put(data)
        elif data[:2] == b"\x57\x86" and len(data) == 8 and data[3] < len(STAGES):
            self.releases[data[2]] = int.from_bytes(data[4:], "little"), data[3], time.monotonic()

    def send(self, data):
        """Send a frame, not faster than the bus is."""
        self.bus.send(can.Message(arbitration_id=HOST, is_extended_id=True, data=data))
        time.sleep(FRAME_GAP)

    def command(self, *data):
        """Send a frame of 8 bytes, filled with zeros."""
        self.send(bytes(data).ljust(8, b"\0"))

    def receive(self, timeout):
        """The next answer, or None after the time-out."""
        try:
            return self.answers.get(timeout=max(timeout, 0.0))
        except queue.Empty:
            return None

    def ask(self, data, *starts, timeout=0.5, tries=1):
        """Send a command; the first answer that begins in one of these ways, or None."""
        for _ in range(tries):
            while not self.answers.empty():  # what came too late
                self.answers.get()
            self.command(*data)
            end = time.monotonic() + timeout
            while (answer := self.receive(end - time.monotonic())) is not None:
                if answer.startswith(starts):
                    return answer
        return None

    def free_slot(self, system):
        """The application slot that does not boot: 0 A, 1 B."""
        answer = self.ask((0x57, 0x05, 2, 0, system), b"\x57\x85\x02", tries=10)
        if not answer:
            raise Failed(f"{name(system)} does not answer questions")
        return 1 if answer[4] == 0 else 0  # byte 8 of the boot environment: the active slot

    def runs(self, system):
        """The version that a system runs now and its stage, or None if it tells nothing."""
        version, stage, at = self.releases.get(system, (0, 0, 0.0))
        return (version, stage) if at > time.monotonic() - 1.0 else None

    def wait_for(self, system, timeout, release=None, stage=0):
        """Wait until a system runs the release, or any, at this stage or later; what it runs."""
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            now = self.runs(system)
            if now and release not in (None, now[0]):
                raise Failed(f"{name(system)} went back to release {now[0]}")
            if now and now[1] >= stage:
                return now
            time.sleep(0.05)
        raise Failed(f"{name(system)} does not tell within {timeout:.0f} s that its release "
                     f"{release or ''} is {STAGES[stage]}")

    def prove(self, system, to_loader):
        """Prove to the loader or to the desk that we have the tester's key; False after silence."""
        named = 0 if to_loader else system
        for _ in range(3):
            challenge = b""
            for part in range(3):
                answer = self.ask((0x57, 0x03, KEY, part, named),
                                  bytes((0x57, 0x83, part)), b"\x57\x84\x02")
                if not answer or answer[1] == 0x84:
                    break
                challenge += answer[3:]
            if answer and answer[1] == 0x84:
                seconds = int.from_bytes(answer[4:6], "little")
                if seconds > PATIENCE:
                    raise Failed(f"{name(system)} takes no proof for {seconds} s, because of "
                                 "proofs with a wrong key")
                time.sleep(seconds)
            if len(challenge) < 15:
                continue
            signature = sign(self.tester_key,
                             b"tandem tester" + bytes((system - 1, KEY)) + challenge) + b"\0"
            parts = [(0x57, 0x04, named << 4 | part, *signature[5 * part:5 * part + 5])
                     for part in range(13)]
            for part in parts[:-1]:
                self.command(*part)
            verdict = self.ask(parts[-1], b"\x57\x84")
            if verdict and verdict[2] == 0:
                return True
            if verdict and verdict[2] == 1:
                raise Failed(f"{name(system)} does not accept this tester's key")
        return False

    def connect(self, system, resume=False, timeout=60.0):
        """Have the application leave, connect to its bootloader, and prove ourselves to it."""
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            answer = self.ask((*CONNECT, system, int(resume)), CONNECTED, REFUSED, timeout=0.005)
            if answer == CONNECTED:
                self.releases.pop(system, None)  # the application has gone
                if self.prove(system, to_loader=True):
                    return
            elif answer and answer[4] == NO_PROOF:
                self.prove(system, to_loader=False)  # after silence the next refusal asks again
            elif answer:
                raise refusal(system, answer)
        raise Failed(f"{name(system)} does not leave for a download within {timeout:.0f} s")

    def download(self, system, records, release):
        """Send the file to the connected bootloader. Ends when the image is on trial."""
        end = time.monotonic() + 180.0
        window = accepted = position = 0
        while accepted < len(records):
            if time.monotonic() > end:
                raise Failed(f"{name(system)}: the download takes too long")
            if not window:  # at the start, and after silence
                answer = self.ask((0x57, 0x01, WINDOW), b"\x57", REFUSED, tries=4)
                if not answer:  # the loader has gone: back to it
                    self.connect(system, resume=True)
                    continue
                if answer.startswith(REFUSED):
                    raise refusal(system, answer)
                window = answer[1]
                position = accepted = self.go_on(answer)
            while position < min(accepted + window, len(records)):
                for at in range(0, len(records[position]), 8):
                    self.send(records[position][at:at + 8])
                position += 1
            answer = self.receive(SILENCE)
            if answer is None:
                now = self.runs(system)
                if now and now[0] == release:
                    return  # only the last acknowledgement was lost
                window = 0
            elif answer.startswith(REFUSED):
                raise refusal(system, answer)
            elif answer.startswith(ACCEPTED):
                accepted = int.from_bytes(answer[4:], "little")
                position = max(position, accepted)
            elif answer.startswith(AGAIN):
                position = accepted = self.go_on(answer)

    def go_on(self, answer):
        """Say that the next record is the one that the answer names, and return its number."""
        self.command(0x57, 0x02, 0, 0, *answer[4:])
        return int.from_bytes(answer[4:], "little")

    def give_up(self, system, release, timeout=60.0):
        """Have a system give up a release on trial; what it runs then."""
        end = time.monotonic() + timeout
        proof_ends = 0.0
        while time.monotonic() < end:
            if time.monotonic() > proof_ends and self.prove(system, to_loader=False):
                proof_ends = time.monotonic() + PROOF_HOLDS
            self.command(0x57, 0x06, 0, 0, system)
            time.sleep(0.1)
            now = self.runs(system)
            if now and now[0] != release:
                return now
        raise Failed(f"{name(system)} still has release {release} after {timeout:.0f} s")


def refusal(system, answer):
    """The error that a refusal stands for."""
    reason = REASONS.get(answer[4], "unknown reason")
    return Failed(f"{name(system)} refuses: {reason} (code {answer[4]})")


def update(vehicle, image, release):
    """Update one system after the other, then wait until both have approved the release."""
    for system in (1, 2):
        now = vehicle.runs(system)
        if now and now[0] == release and now[1] >= WORKS:
            print(f"{name(system)} runs release {release} already")
            continue
        slot = vehicle.free_slot(system)
        records = s_records(image, slot)
        print(f"{name(system)}: release {release} to slot {'AB'[slot]}", flush=True)
        vehicle.connect(system)
        vehicle.download(system, records, release)
        vehicle.wait_for(system, 30.0, release, WORKS)
        print(f"{name(system)}: release {release} works", flush=True)
    for system in (1, 2):
        vehicle.wait_for(system, 30.0, release, APPROVED)
        print(f"{name(system)} runs release {release}, approved")


def go_back(vehicle, release):
    """Give the old release back to a system that has the new one on trial; wait for both."""
    for system in (1, 2):
        try:
            version, stage = vehicle.wait_for(system, 30.0)
            if version == release and stage < APPROVED:
                print(f"{name(system)} shall give release {release} up", flush=True)
                version, stage = vehicle.give_up(system, release)
            print(f"{name(system)} runs release {version}, {STAGES[stage]}", flush=True)
        except Failed as failure:
            print(f"error: {failure}", file=sys.stderr)


def parse():
    """The command line. Prepares the image, so that bad keys count as wrong usage."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--release", type=int, required=True, help="number of the new release")
    parser.add_argument("--key", required=True, help="private key that signs (Ed25519, DER)")
    parser.add_argument("--tester-key", required=True, help="the tester's private key")
    parser.add_argument("--group", default="239.74.163.2", help="multicast group of the bus")
    parser.add_argument("--port", type=int, default=43113, help="its port")
    options = parser.parse_args()
    if not 0 < options.release < 1 << 32:
        parser.error("--release: a number from 1 to 4294967295")
    try:
        sign(options.tester_key, b"can this key sign?")
        return options, build_image(options.release, options.key)
    except Failed as failure:
        parser.error(str(failure))


def main():
    """Update the vehicle; the exit status."""
    options, image = parse()
    filters = [{"can_id": x, "can_mask": 0x1FFF_FFFF, "extended": True} for x in (ANSWER, RELEASE)]
    try:
        with can.Bus(channel=options.group, port=options.port, interface="udp_multicast",
                     can_filters=filters) as bus:
            vehicle = Vehicle(bus, options.tester_key)
            with can.Notifier(bus, [vehicle], timeout=0.1):
                for system in (1, 2):
                    vehicle.wait_for(system, 5.0)
                try:
                    update(vehicle, image, options.release)
                    return 0
                except (Failed, can.CanError, KeyboardInterrupt) as failure:
                    print(f"error: {str(failure) or 'interrupted'}", file=sys.stderr, flush=True)
                    go_back(vehicle, options.release)
    except (Failed, can.CanError, OSError) as failure:
        print(f"error: {failure}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
