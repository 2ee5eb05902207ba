"""A host for Tandem's bootloader on python-can, written from docs/boot.md alone.

usage: host.py FILE [--group ADDRESS] [--port PORT]
"""

import argparse
import struct
import sys
import time

import can

TO_HOST, TO_LOADER = 0x0CFF0127, 0x0CFF0126
CONNECT, CONNECTED = 0x083E572D, 0x0706050403020100
ACCEPTED, RESEND, REFUSED = 0x214B1D, 0x534F53, 0x44454E

arguments = argparse.ArgumentParser()
arguments.add_argument("file")
arguments.add_argument("--group", default="239.74.163.2")
arguments.add_argument("--port", type=int, default=43113)
arguments = arguments.parse_args()


def send(bus, data):
    bus.send(can.Message(arbitration_id=TO_LOADER, is_extended_id=True, data=data))


def answer(bus, seconds):
    """The next answer: its low and its high 32 bits, or None."""
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        message = bus.recv(left)
        if message and message.is_extended_id and message.arbitration_id == TO_HOST:
            return struct.unpack("<II", message.data)
    return None


def transfer(bus, lines):
    for _ in range(4000):
        send(bus, struct.pack("<Q", CONNECT))
        reply = answer(bus, 0.005)
        if reply and reply[0] | reply[1] << 32 == CONNECTED:
            break
    else:
        return "no bootloader answers"
    # Further acknowledgements of the same connect request may be under way.
    for line in lines:
        for _ in range(16):
            for start in range(0, len(line), 8):
                send(bus, line[start : start + 8])
            reply = answer(bus, 3)
            while reply and reply[0] | reply[1] << 32 == CONNECTED:
                reply = answer(bus, 3)
            if reply and reply[0] == ACCEPTED:
                break
            if reply and reply[0] == REFUSED:
                return f"refused: {reply[1]}"
        else:
            return "the record does not get through"
    return "accepted"


with open(arguments.file, "rb") as file:
    records = [line.rstrip(b"\r\n") + b"\r\n" for line in file if line.strip()]
with can.Bus(
    interface="udp_multicast", channel=arguments.group, port=arguments.port, receive_own_messages=False
) as channel:
    result = transfer(channel, records)
print(result)
sys.exit(0 if result == "accepted" else 1)
