#!/usr/bin/env python3
"""Watches a run of Tandem through the iceoryx2 services that it publishes.

    python3 -m pip install iceoryx2==0.10.0
    python3 cli/examples/observe.py RUN [SECONDS]

RUN is the last column of `tandem ps`. Prints roles, vehicle and events; counts CAN frames. The
layouts are those of board/host/src/services.rs.
"""

import ctypes
import sys
import time

import iceoryx2 as iox2

STATES = ["off", "starting", "standby", "master", "degraded master", "safe stop", "suspended",
          "parking"]


class Roles(ctypes.Structure):
    _fields_ = [
        ("at_ns", ctypes.c_uint64),
        ("time_s", ctypes.c_double),
        ("duration_s", ctypes.c_double),
        ("gap_max_ms", ctypes.c_double),
        ("takeover_gap_ms", ctypes.c_double),
        ("takeovers", ctypes.c_uint32),
        ("term", ctypes.c_uint32),
        ("obeyed", ctypes.c_uint8),
        ("state", ctypes.c_uint8 * 2),
        ("alive", ctypes.c_uint8 * 6),
        ("beats", ctypes.c_uint8 * 2),
        ("cuts", ctypes.c_uint8 * 2),
        ("reserved", ctypes.c_uint8 * 3),
    ]

    @staticmethod
    def type_name():
        return "TandemRoles"


class Vehicle(ctypes.Structure):
    _fields_ = [("at_ns", ctypes.c_uint64)] + [
        (name, ctypes.c_double)
        for name in ["x", "y", "heading", "speed", "accel", "lat_accel", "lateral_error", "lead_gap"]
    ] + [("lane", ctypes.c_int64)]

    @staticmethod
    def type_name():
        return "TandemVehicle"


class CanFrame(ctypes.Structure):
    _fields_ = [
        ("at_ns", ctypes.c_uint64),
        ("id", ctypes.c_uint32),
        ("flags", ctypes.c_uint8),
        ("ruling", ctypes.c_uint8),
        ("length", ctypes.c_uint8),
        ("reserved", ctypes.c_uint8),
        ("data", ctypes.c_uint8 * 64),
    ]

    @staticmethod
    def type_name():
        return "TandemCanFrame"


class Event(ctypes.Structure):
    _fields_ = [
        ("at_ns", ctypes.c_uint64),
        ("system", ctypes.c_uint8),
        ("core", ctypes.c_uint8),
        ("length", ctypes.c_uint8),
        ("reserved", ctypes.c_uint8 * 5),
        ("text", ctypes.c_uint8 * 112),
    ]

    @staticmethod
    def type_name():
        return "TandemEvent"


class Number(ctypes.Structure):
    """The user header of each sample: counts them from 0. A gap tells how many were lost."""

    _fields_ = [("number", ctypes.c_uint64)]

    @staticmethod
    def type_name():
        return "TandemNumber"


def subscriber(node, run, name, payload):
    service = node.service_builder(iox2.ServiceName.new(f"tandem/{run}/{name}"))
    service = service.publish_subscribe(payload).user_header(Number).open()
    return service.subscriber_builder().create()


def samples(of):
    while (sample := of.receive()) is not None:
        yield sample.payload().contents


def main():
    run = sys.argv[1]
    until = time.monotonic() + (float(sys.argv[2]) if len(sys.argv) > 2 else 10.0)
    iox2.set_log_level(iox2.LogLevel.Error)
    node = iox2.NodeBuilder.new().create(iox2.ServiceType.Ipc)
    roles = subscriber(node, run, "roles", Roles)
    vehicle = subscriber(node, run, "vehicle", Vehicle)
    can = subscriber(node, run, "can", CanFrame)
    trace = subscriber(node, run, "trace", Event)
    frames, speed = 0, 0.0
    while time.monotonic() < until:
        frames += sum(1 for _ in samples(can))
        for state in samples(vehicle):
            speed = state.speed
        for event in samples(trace):
            of = "supply" if event.core == 255 else f"core {event.core}"
            print(f"{'AB'[event.system]} {of}: {bytes(event.text[:event.length]).decode()}")
        for now in samples(roles):
            a, b = (STATES[state] for state in now.state)
            print(f"{now.time_s:.1f} s: A {a}, B {b}, term {now.term}, {speed:.1f} m/s, "
                  f"{now.takeovers} takeovers, {frames} frames", flush=True)
        time.sleep(0.1)


if __name__ == "__main__":
    main()
