"""The other side of cantools_oracle.rs: the same DBC through cantools, an independent implementation.

    cantools_oracle.py DBC decode             frames from stdin, their values to stdout
    cantools_oracle.py DBC encode SEED COUNT  random values and their frames to stdout

A frame is `id data`, both in hex; values are `name=value` with physical numbers. Where both stand in
one line it is `id data name=value …`. `E2E` is 1 if the protection is right by Python's own CRC.
"""

import binascii
import random
import sys

import cantools


def protected(frame_id, data):
    crc = binascii.crc_hqx(data[2:] + frame_id.to_bytes(2, "little"), 0xFFFF)
    return data[:2] == crc.to_bytes(2, "little")


def decode(db):
    for line in sys.stdin:
        frame_id, data = line.split()
        frame_id, data = int(frame_id, 16), bytes.fromhex(data)
        values = db.decode_message(frame_id, data, decode_choices=False)
        print(f"E2E={int(protected(frame_id, data))}", *(f"{k}={v!r}" for k, v in values.items()))


def random_value(signal):
    if signal.choices:
        return random.choice(list(signal.choices))
    raw = [round(limit / signal.scale) for limit in (signal.minimum, signal.maximum)]
    # Try the limits often: errors of sign and width appear there.
    return random.choice([*raw, 0, random.randint(*raw), random.randint(*raw)]) * signal.scale


def encode(db, seed, count):
    random.seed(seed)
    for message in db.messages * count:
        values = {s.name: random_value(s) for s in message.signals}
        if "System" in values:
            values["System"] = int(message.name[-1] == "B")
        # Scaling to and from floats leaves some values slightly out of range.
        data = message.encode(values, strict=False)
        print(f"{message.frame_id:03x} {data.hex()}", *(f"{k}={v!r}" for k, v in values.items()))


if __name__ == "__main__":
    database = cantools.database.load_file(sys.argv[1])
    if sys.argv[2] == "decode":
        decode(database)
    else:
        encode(database, int(sys.argv[3]), int(sys.argv[4]))
