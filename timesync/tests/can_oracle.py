"""The other side of can_oracle.rs: a tester for time over CAN, written from the layout of AUTOSAR's
document 674 and not from the crate (pip install python-can crccheck).

    can_oracle.py decode   reads pairs `system sync follow-up` in hex and prints what each means
    can_oracle.py script   prints `at-us system frame answer`, or `new policy` for a new slave

An answer is `wait`, `time:ns:gateway` or the name of a refusal.
"""

import random
import struct
import sys

import can
from crccheck.crc import Crc8Autosar

# The lists of data ids, each by the sequence counter.
DATA_IDS = {
    ("A", "sync"): list(range(0, 16)),
    ("A", "fup"): list(range(16, 32)),
    ("B", "sync"): list(range(32, 48)),
    ("B", "fup"): list(range(48, 64)),
}
TYPES = {0x10: ("sync", False), 0x18: ("fup", False), 0x20: ("sync", True), 0x28: ("fup", True)}
CAN_IDS = {"A": 0x7A, "B": 0x7B}
S = 1_000_000_000


def crc_of(system, kind, data):
    return Crc8Autosar.calc(data[2:8] + bytes([DATA_IDS[system, kind][data[2] & 15]]))


def message(system, kind, secured, counter, value, byte3=0, byte1=0, domain=0):
    """A frame as python-can would send it: classic, 8 bytes."""
    code = next(code for code, what in TYPES.items() if what == (kind, secured))
    data = struct.pack(">BBBBI", code, byte1, domain << 4 | counter, byte3, value)
    if secured:
        data = data[:1] + bytes([crc_of(system, kind, data)]) + data[2:]
    return can.Message(arbitration_id=CAN_IDS[system], is_extended_id=False, data=data, check=True)


def decode():
    """Prints `secured counter gateway ns` of each pair, or what is wrong with it."""
    for line in sys.stdin:
        system, *frames = line.split()
        what = []
        for text in frames:
            code, check, place, flags, value = struct.unpack(">BBBBI", bytes.fromhex(text))
            kind, secured = TYPES[code]
            right = crc_of(system, kind, bytes.fromhex(text)) if secured else 0
            assert check == right and place >> 4 == 0, line
            what.append((kind, secured, place & 15, flags, value))
        (sync, secured, counter, user, seconds), (fup, *same, flags, ns) = what
        assert (sync, fup, same, user) == ("sync", "fup", [secured, counter], 0), line
        assert flags < 8 and ns < S, line
        print(int(secured), counter, flags >> 2 & 1, (seconds + (flags & 3)) * S + ns)


def say(at_us, frame, answer):
    system = "A" if frame.arbitration_id == CAN_IDS["A"] else "B"
    print(at_us, system, frame.data.hex(), answer)


def policies():
    """Each policy with frames without CRC, with the right one and with all wrong ones."""
    accepts = {
        "Validated": (False, True, False),
        "NotValidated": (True, False, False),
        "Optional": (True, True, False),
        "Ignored": (True, True, True),
    }
    for policy, (plain, right, wrong) in accepts.items():
        print("new", policy)
        for n in range(64):
            # Far apart, so that the master is a new one each time and no counter jumps.
            system, counter, at_us = "AB"[n // 32], n % 16, 2_000_000 * n
            kind, accepted = ("sync", "wait") if n % 32 < 16 else ("fup", "NoSync")
            good = message(system, kind, True, counter, 77)
            say(at_us, message(system, kind, False, counter, 77), accepted if plain else "Crc")
            say(at_us + 400_000, good, accepted if right else "Crc")
            for other in range(256) if n % 7 == 0 and not wrong else ():
                bad = can.Message(arbitration_id=good.arbitration_id, data=good.data)
                bad.data[1] = other
                if other != good.data[1]:
                    say(at_us + 500_000, bad, "Crc")
            bad = can.Message(arbitration_id=CAN_IDS["BA"[n // 32]], data=good.data)
            say(at_us + 800_000, bad, accepted if wrong else "Crc")


def corruption():
    """Each single bit of a frame, and other lengths."""
    print("new Validated")
    for kind in ("sync", "fup"):
        good = message("A", kind, True, 5, 0x01234567, byte3=1)
        for bit in range(64):
            bad = can.Message(arbitration_id=good.arbitration_id, data=good.data)
            bad.data[bit // 8] ^= 1 << bit % 8
            known = bad.data[0] in TYPES
            say(0, bad, "Crc" if known else "Layout")
        for size in range(8):
            print(0, "A", good.data[:size].hex() or "-", "Layout")
        print(0, "A", good.data.hex() + "00", "Layout")


def refusals():
    """One of each answer, with the frames and times around each limit."""
    print("new Optional")

    def sync(counter, s=1, system="A", **more):
        return message(system, "sync", True, counter, s, **more)

    def fup(counter, ms, ovs=0, system="A", secured=True, **more):
        return message(system, "fup", secured, counter, ms * 1_000_000, byte3=ovs, **more)

    say(0, fup(0, 0), "NoSync")
    # The local clock shows 0.9 s when the global time is 1.9 s.
    for at_us, counter, ms in ((900_000, 14, 900), (1_000_000, 15, 1000)):
        say(at_us, sync(counter), "wait")
        say(at_us + 50_000, fup(counter, ms % 1000, ms // 1000), "Learning")
    say(1_100_000, sync(0, 2), "wait")
    say(1_101_000, fup(1, 100), "NoSync")
    say(1_101_000, fup(0, 100, secured=False), "NoSync")
    say(1_101_000, fup(0, 100, domain=1), "Domain")
    say(1_101_000, sync(1, domain=15), "Domain")
    say(1_105_000, fup(0, 100), "time:2100000000:0")
    say(1_106_000, fup(0, 100), "NoSync")
    say(1_107_000, sync(0, 2), "Doubled")
    say(1_108_000, fup(0, 100), "NoSync")
    # Three SYNC are lost; reserved bits do not count.
    say(1_400_000, sync(3, 2), "wait")
    say(1_450_000, fup(3, 400, 0b11111100), "time:2400000000:1")
    say(1_500_000, sync(7, 2), "Counter")
    say(1_501_000, fup(7, 500), "NoSync")
    say(1_600_000, sync(8, 2), "wait")
    say(1_650_001, fup(8, 600), "Late")
    # SYNC arrives twice: the stamp of the first is not that of the sender.
    say(1_700_000, sync(9, 2), "wait")
    say(1_700_300, sync(9, 2), "Doubled")
    say(1_705_000, fup(9, 700), "NoSync")
    say(1_800_000, sync(10, 2), "wait")
    say(1_805_000, message("A", "fup", True, 10, S), "Range")
    say(1_806_000, fup(10, 800), "NoSync")
    say(1_900_000, sync(11, 2), "wait")
    say(1_905_000, fup(11, 902), "OutOfLine(2000000)")
    # B is heard when A has been silent for 350 ms, and continues the line.
    say(2_250_000, sync(9, 3, system="B"), "OtherMaster")
    say(2_250_001, sync(9, 3, system="B"), "wait")
    say(2_250_002, sync(12, 3), "OtherMaster")
    say(2_255_001, fup(9, 250, system="B"), "time:3250000000:0")
    say(2_256_000, fup(11, 900), "OtherMaster")
    # The local clock goes back: the slave chooses its master again.
    say(1_000_000, sync(3, 3), "wait")
    say(1_001_000, fup(3, 300), "OutOfLine(50000000)")


def random_periods():
    """A master that is always right, up to the last second; up to two SYNC in a row are lost."""
    random.seed(1)
    for last in (2_000 * S, (1 << 32) * S - 1):
        print("new Validated")
        period, given = 0, 0
        while period < 1000:
            counter, at_us = period % 16, period * 100_000
            now = last - (1000 - period) * 100_000_000
            ovs, gateway = random.randrange(4), random.randrange(2)
            user, reserved = random.randrange(256), random.randrange(32)
            say(at_us, message("B", "sync", True, counter, now // S - ovs, user), "wait")
            flags = reserved << 3 | gateway << 2 | ovs
            answer = f"time:{now}:{gateway}" if given >= 2 else "Learning"
            delay = random.randrange(50_001)
            say(at_us + delay, message("B", "fup", True, counter, now % S, flags), answer)
            given += 1
            period += random.choice([1, 1, 1, 2, 3])


if __name__ == "__main__":
    if sys.argv[1] == "decode":
        decode()
    else:
        policies()
        corruption()
        refusals()
        random_periods()
