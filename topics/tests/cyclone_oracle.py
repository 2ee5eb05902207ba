"""The other side of cyclone_oracle.rs: the types of tandem.idl in Cyclone DDS, which is not ours.

    cyclone_oracle.py decode             types and payloads from stdin
    cyclone_oracle.py encode SEED COUNT  COUNT random samples of each type

Each sample becomes a line `type E2E=0|1 name=value … payload payload payload payload`. The payloads
are, in hex: XCDR1 little-endian and big-endian, XCDR2 little-endian and big-endian. Floats are
their bits in hex. `E2E` is 1 if the protection is right by Python's own CRC.
"""

import binascii
import random
import struct
import sys
from dataclasses import dataclass, fields

from cyclonedds.idl import IdlEnum, IdlStruct
from cyclonedds.idl._support import Endianness
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import array, float32, uint8, uint16, uint32


class Gear(IdlEnum, typename="tandem.Gear"):
    PARK = 0
    NEUTRAL = 1
    DRIVE = 2


class BrakeRequest(IdlEnum, typename="tandem.BrakeRequest"):
    KEEP = 0
    APPLY = 1
    RELEASE = 2


@dataclass
@final
class CanFrame(IdlStruct, typename="tandem.CanFrame"):
    id: uint32
    period_ms: uint16
    length: uint8
    data: array[uint8, 64]


@dataclass
@final
class PowerControl(IdlStruct, typename="tandem.PowerControl"):
    crc: uint16
    counter: uint8
    target_speed: float32
    acceleration: float32
    distance: float32
    target_gear: Gear


@dataclass
@final
class LateralControl(IdlStruct, typename="tandem.LateralControl"):
    crc: uint16
    counter: uint8
    enable: bool
    road_wheel_angle: float32


@dataclass
@final
class LongitudinalControl(IdlStruct, typename="tandem.LongitudinalControl"):
    crc: uint16
    counter: uint8
    enable: bool
    brake_torque: float32
    speed: float32


@dataclass
@final
class ParkingBrake(IdlStruct, typename="tandem.ParkingBrake"):
    crc: uint16
    counter: uint8
    request: BrakeRequest


# Each type with its data id; CanFrame is not protected.
TYPES = {
    CanFrame: None,
    PowerControl: 0x8001,
    LateralControl: 0x8002,
    LongitudinalControl: 0x8003,
    ParkingBrake: 0x8004,
}
RANGES = {
    "length": (0, 64),
    "target_speed": (0.0, 327.67),
    "acceleration": (-32.768, 32.767),
    "distance": (0.0, 6553.5),
    "road_wheel_angle": (-0.65536, 0.65534),
    "brake_torque": (0.0, 20000.0),
    "speed": (0.0, 327.67),
}


def name(of):
    return of.__idl_typename__.replace(".", "::")


def crc(sample):
    body = sample.serialize(endianness=Endianness.Little, use_version_2=False)[4:]
    return binascii.crc_hqx(body[2:] + TYPES[type(sample)].to_bytes(2, "little"), 0xFFFF)


def word(value):
    if isinstance(value, float):
        return struct.pack(">f", value).hex()
    if isinstance(value, IdlEnum):
        return str(value.value)
    return str(int(value)) if isinstance(value, (bool, int)) else bytes(value).hex()


def show(sample):
    of = type(sample)
    protected = TYPES[of] is not None and sample.crc == crc(sample)
    words = (f"{field.name}={word(getattr(sample, field.name))}" for field in fields(of))
    kinds = ((version, order) for version in (1, 2) for order in (Endianness.Little, Endianness.Big))
    payloads = (sample.serialize(endianness=order, use_version_2=it == 2).hex() for it, order in kinds)
    print(name(of), f"E2E={int(protected)}", *words, *payloads)


def decode():
    types = {name(of): of for of in TYPES}
    for line in sys.stdin:
        of, payload = line.split()
        show(types[of].deserialize(bytes.fromhex(payload)))


def random_value(field):
    if field.name in RANGES:
        low, high = RANGES[field.name]
        between = random.randint(low, high) if field.name == "length" else random.uniform(low, high)
        # Errors of sign and width appear at the limits.
        return random.choice([low, high, 0 * low, between, between])
    if isinstance(field.type, type) and issubclass(field.type, IdlEnum):
        return random.choice(list(field.type))
    if field.type is bool:
        return random.choice([False, True])
    if field.name == "data":
        return [random.randrange(256) for _ in range(64)]
    bits = {"id": 32, "period_ms": 16, "crc": 16, "counter": 8}[field.name]
    return random.choice([0, 2**bits - 1, random.getrandbits(bits)])


def encode(seed, count):
    random.seed(seed)
    for of in list(TYPES) * count:
        sample = of(*(random_value(field) for field in fields(of)))
        if TYPES[of] is not None and random.random() < 0.5:
            sample.crc = crc(sample)
        show(sample)


if __name__ == "__main__":
    if sys.argv[1] == "decode":
        decode()
    else:
        encode(int(sys.argv[2]), int(sys.argv[3]))
